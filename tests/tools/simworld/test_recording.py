# SPDX-License-Identifier: Apache-2.0
"""What is written can be read by the product, and says what was rendered."""

import json
from pathlib import Path as FilePath

import cv2
import numpy as np
import pytest

from edge.cameras.recording import open_recording
from tools.simworld import cli
from tools.simworld.paths import Path, make_path
from tools.simworld.recording import Recipe, seconds, write_recording
from tools.simworld.renderer import Renderer


@pytest.fixture(scope="module")
def path(corner: Renderer) -> Path:
    return make_path(corner.world, 2, 1.0, 30.0)


def test_recording_is_read_back_as_it_was(corner: Renderer, path: Path, tmp_path: FilePath) -> None:
    recipe = Recipe(every=4, depth=True, ids=True, image_format="png")
    write_recording(tmp_path, corner, path, recipe)
    recording = open_recording(tmp_path)
    assert recording.camera == corner.camera
    assert recording.rate_hz == pytest.approx(30.0)
    np.testing.assert_array_equal(recording.t_ns, path.t_ns[::4])
    truth = recording.groundtruth
    assert truth is not None
    np.testing.assert_allclose(truth[1], path.T_world_cam[::4], atol=2e-9)
    for i, T in enumerate(path.T_world_cam[::4]):
        view = corner.render(T)
        np.testing.assert_array_equal(recording.colour(i), view.bgr[:, :, ::-1])  # red first
        depth = recording.depth(i)
        assert depth is not None
        np.testing.assert_allclose(depth, view.depth_m, atol=0.51e-3)
        ids = cv2.imread(str(tmp_path / "ids" / f"{4 * i:06d}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(ids, view.ids)
    info = json.loads((tmp_path / "info.json").read_text())
    assert info["objects"] == {str(t.id): [t.name, t.label] for t in corner.world.things}


def test_workers_do_not_change_a_byte(corner: Renderer, path: Path, tmp_path: FilePath) -> None:
    for workers in (1, 3):
        write_recording(tmp_path / str(workers), corner, path, Recipe(workers=workers, depth=True))
    files = sorted(f.relative_to(tmp_path / "1") for f in (tmp_path / "1").rglob("*.*"))
    assert len(files) == 30 + 30 + 5
    for file in files:
        assert (tmp_path / "1" / file).read_bytes() == (tmp_path / "3" / file).read_bytes()


def test_stamps_are_exact() -> None:
    assert seconds(1403715273262142976) == "1403715273.262142976"
    assert seconds(50_000_000) == "0.050000000"


OPTIONS = ["--room", "lines", "--size", "96", "72", "--seconds", "0.5", "--rate", "10"]


def test_command_writes_the_drives_that_were_asked_for(tmp_path: FilePath) -> None:
    out = str(tmp_path / "out")
    assert cli.main([*OPTIONS, "--drives", "map,query,changed", "--out", out]) == 0
    lengths = {n: len(open_recording(tmp_path / "out" / n)) for n in ("map", "query", "changed")}
    assert lengths == {"map": 1, "query": 5, "changed": 5}
    assert open_recording(tmp_path / "out" / "map").has_depth
    assert not open_recording(tmp_path / "out" / "query").has_depth
    info = json.loads((tmp_path / "out" / "changed" / "info.json").read_text())
    assert {c["kind"] for c in info["changes"]} == {"added", "removed"}


@pytest.mark.parametrize(
    "wrong",
    [
        ["--drives", "map,lost"],
        ["--distortion", "radtan:a,b"],
        ["--distortion", "fish:0.1"],
        ["--seconds", "-1"],
        ["--vignette", "2"],
    ],
)
def test_wrong_options_are_told_in_one_line(
    wrong: list[str], tmp_path: FilePath, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*OPTIONS, *wrong, "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()
