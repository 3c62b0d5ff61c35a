# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.cameras import euroc
from edge.cameras.recording import open_recording
from edge.errors import RecordingError
from tests.edge.cameras.recordings import EUROC_T0_NS, SENSOR_YAML, picture, write_euroc


def test_times_keep_all_nineteen_digits(tmp_path: Path) -> None:
    recording = open_recording(write_euroc(tmp_path))

    assert recording.t_ns.tolist() == [EUROC_T0_NS + 50_000_000 * i for i in range(4)]
    assert [frame.t_ns for frame in recording] == recording.t_ns.tolist()


def test_the_camera_is_read_from_its_yaml(tmp_path: Path) -> None:
    camera = open_recording(write_euroc(tmp_path)).camera

    assert camera.pinhole == (64, 48, 50.0, 51.0, 31.5, 23.5)
    assert camera.distortion_model == "radtan"
    assert camera.distortion == (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)


def test_truth_is_moved_from_the_body_to_the_camera(tmp_path: Path) -> None:
    truth = open_recording(write_euroc(tmp_path)).groundtruth
    assert truth is not None
    T = truth.pose_at(EUROC_T0_NS)

    # The body is turned about z, its x axis to (-0.28, 0.96) and its y axis to (-0.96, -0.28); the
    # camera sits at (0, 0.2, 0.3) in the body, its x and y axes are the body's y and -x.
    assert T[:3, 3] == pytest.approx([-0.192, 1.944, 3.3])
    assert T[:3, 0] == pytest.approx([-0.96, -0.28, 0.0], abs=1e-12)
    assert T[:3, 1] == pytest.approx([0.28, -0.96, 0.0], abs=1e-12)
    assert truth.pose_at(EUROC_T0_NS + 12_500_000)[0, 3] == pytest.approx(-0.192 + 0.0125)


def test_truth_of_another_body_frame_is_moved_there_first(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    folder = tmp_path / "mav0" / "state_groundtruth_estimate0"
    (folder / "sensor.yaml").write_text(
        "T_BS:\n  data: [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    )
    truth = open_recording(tmp_path).groundtruth

    assert truth is not None
    assert truth.T_world_cam[0, :3, 3] == pytest.approx([-0.192 + 0.14, 1.944 - 0.48, 3.3])


def test_the_right_camera_goes_by_time_and_its_pose_by_both_yamls(tmp_path: Path) -> None:
    recording = open_recording(write_euroc(tmp_path))

    assert recording.right(1) is None
    assert np.array_equal(recording.right(2), picture(3))
    # 0.1 m along the body's x is the left camera's -y.
    assert recording.T_left_right[:3, 3] == pytest.approx([0.0, -0.1, 0.0])
    assert recording.T_left_right[:3, :3] == pytest.approx(np.eye(3))


def test_one_camera_and_no_truth_are_enough(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    (tmp_path / "mav0" / "cam1" / "data.csv").unlink()
    (tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv").unlink()
    recording = open_recording(tmp_path)

    assert len(list(recording)) == 4
    assert recording.right(0) is None
    assert recording.groundtruth is None


def test_an_equidistant_lens_is_read(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    path = tmp_path / "mav0" / "cam0" / "sensor.yaml"
    text = SENSOR_YAML.format(name="cam0", x=0.0).replace("radial-tangential", "equidistant")
    path.write_text(text)

    assert open_recording(tmp_path).camera.distortion_model == "equidistant"


def test_yaml_keeps_what_stands_before_comments_and_joins_lists() -> None:
    text = (
        "%YAML:1.0\n---\na: 1 # one\nb: 'x#y'\nc: [1,\n  2, 3] #end\nd:\n  e: f\n# g: 1\nh: [ ]\n"
    )

    expected = {"a": "1", "b": "x#y", "c": ["1", "2", "3"], "d.e": "f", "h": []}
    assert euroc.parse_yaml(text) == expected


def test_yaml_reads_lists_of_a_line_for_each_item() -> None:
    text = "a:\n- -0.28 # k1\n- 7.0e-02\nb: 1\nc:\n  d:\n    - 1\n    - 2\n  e: x\nf: -1\n"

    expected = {"a": ["-0.28", "7.0e-02"], "b": "1", "c.d": ["1", "2"], "c.e": "x", "f": "-1"}
    assert euroc.parse_yaml(text) == expected


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("intrinsics", "intrinsic", "intrinsics: has 0 numbers, 4 are needed"),
        ("[50.0, 51.0", "[50.0", "intrinsics: has 3 numbers"),
        ("[50.0, 51.0", "[fifty, 51.0", "intrinsics: .*'fifty'"),
        ("[50.0, 51.0", "[-50.0, 51.0", "fx: -50"),
        ("[64, 48]", "[64.5, 48]", "width: 64.5"),
        ("rate_hz: 20", "rate_hz: 0", "rate_hz: 0"),
        ("pinhole", "omni", "camera_model: 'omni'"),
        ("radial-tangential", "fov", "distortion_model: 'fov' is unknown"),
        ("data: [0.0, -1.0", "data: [9.0, -1.0", "T_BS: is no rigid"),
        ("data: [0.0, -1.0", "data: [nan, -1.0", "T_BS.data: .* not finite"),
        ("data: [0.0, -1.0,", "data: [0.0,", "T_BS.data: has 15 numbers"),
    ],
)
def test_a_bad_yaml_is_named(tmp_path: Path, old: str, new: str, word: str) -> None:
    write_euroc(tmp_path)
    path = tmp_path / "mav0" / "cam0" / "sensor.yaml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))

    with pytest.raises(RecordingError, match=rf"sensor\.yaml: {word}"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (None, r"data\.csv: is missing"),
        ("#timestamp [ns],filename\n", "lists no image"),
        ("1403715273.26,1.png\n", "line 1: .* nanoseconds"),
        ("2,2.png\n1,1.png\n", "line 2: time is not after"),
        ("2\n", "line 1: has no file name"),
    ],
)
def test_a_bad_list_is_named(tmp_path: Path, text: str | None, word: str) -> None:
    write_euroc(tmp_path)
    path = tmp_path / "mav0" / "cam0" / "data.csv"
    path.unlink() if text is None else path.write_text(text)

    with pytest.raises(RecordingError, match=word):
        open_recording(tmp_path)
