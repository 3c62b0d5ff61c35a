# SPDX-License-Identifier: Apache-2.0
import csv
import json
from pathlib import Path

import numpy as np
import pytest

from edge.errors import OutputError
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.outputs.run_folder import RunFolder, is_run_folder
from edge.types import Mat4
from tests.edge.outputs import reports

CAMERA = CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5)
STATS = {"frames": 4, "fixes_tried": 2, "ms": {}}
CONTRACT = {
    "poses.tum",
    "odometry.tum",
    "poses_smooth.tum",
    "covariance.csv",
    "trajectory.tum",
    "points.ply",
    "fixes.jsonl",
    "changes.jsonl",
    "frames.csv",
    "stats.json",
}


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def write_run(
    path: Path, frames: int = 4, trajectory: list[tuple[int, Mat4]] | None = None
) -> None:
    folder = RunFolder(path, CAMERA)
    for index in range(frames):
        folder.write(reports.report(index, published=index > 0, with_keyframe=index % 2 == 1))
    folder.finish(trajectory or [], STATS)


def test_all_files_of_the_contract_are_there(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    assert {file.name for file in (tmp_path / "run").iterdir()} == CONTRACT
    assert list(tmp_path.iterdir()) == [tmp_path / "run"]


def test_empty_run_is_a_run(tmp_path: Path) -> None:
    RunFolder(tmp_path / "run", CAMERA).finish([], STATS)
    assert is_run_folder(tmp_path / "run")
    assert (tmp_path / "run" / "poses.tum").read_text() == ""


def test_poses_are_those_published(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    table = np.loadtxt(tmp_path / "run" / "poses.tum")
    assert len(table) == 3
    pose = reports.report(2).pose
    assert pose is not None
    assert np.allclose(se3.from_tum(table[1, 1:]), pose.T_map_cam, atol=1e-8)
    assert (tmp_path / "run" / "poses.tum").read_text().startswith("0.033333333 ")
    assert (tmp_path / "run" / "poses_smooth.tum").read_text().count("\n") == 3


def test_nanoseconds_survive(tmp_path: Path) -> None:
    t_ns = 1403715273262142976
    write_run(tmp_path / "run", trajectory=[(t_ns, np.eye(4)), (-5, np.eye(4))])
    lines = (tmp_path / "run" / "trajectory.tum").read_text().splitlines()
    assert lines[0].split()[0] == "1403715273.262142976"
    assert lines[1].split()[0] == "-0.000000005"


def test_covariance_has_22_columns_and_reads_back(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    header, *lines = csv.reader((tmp_path / "run" / "covariance.csv").read_text().splitlines())
    assert header[:3] == ["t_ns", "x_x", "x_y"]
    assert len(header) == 22
    assert len(lines) == 3
    terms = np.array([float(term) for term in lines[0][1:]])
    assert np.allclose(terms, reports.covariance()[np.triu_indices(6)], rtol=1e-8)


def test_frames_csv_has_the_columns_of_the_contract(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    lines = (tmp_path / "run" / "frames.csv").read_text().splitlines()
    assert lines[0] == (
        "index,t_ns,state,odom_id,keyframe,track_ms,keyframe_ms,frame_ms,latency_ms,"
        "quality,sigma_m,scale,reset_counter"
    )
    assert lines[1] == "0,0,tracking,1,0,1.000,2.000,3.500,4.000,0.7500,,,"
    assert lines[2].startswith("1,33333333,tracking,1,0,1.000,2.000,3.500,4.000,0.7500,0.0")
    assert lines[2].endswith(",1,2")


def test_each_odometry_frame_has_its_file(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run", CAMERA)
    for index, odom_id in enumerate([1, 1, 3, 3, 3]):
        folder.write(reports.report(index, odom_id=odom_id))
    folder.write(reports.lost(5, odom_id=3))
    folder.finish([], STATS)
    assert (tmp_path / "run" / "odometry.tum").read_text().count("\n") == 2
    assert (tmp_path / "run" / "odometry-3.tum").read_text().count("\n") == 3
    assert not (tmp_path / "run" / "odometry-2.tum").exists()


def test_many_restarts_keep_few_files_open(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run", CAMERA)
    folder.write(reports.report(0, odom_id=1))
    before = open_files()
    for index in range(2, 50):
        folder.write(reports.report(index, odom_id=index))
    assert open_files() == before
    folder.abort()


def test_fixes_are_told_with_their_verdict(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run", CAMERA)
    fixes = (reports.fix(3), reports.fix(4, accepted=False))
    folder.write(reports.report(6, fixes=fixes))
    folder.finish([], STATS)
    good, bad = map(json.loads, (tmp_path / "run" / "fixes.jsonl").read_text().splitlines())
    keys = "t_ns accepted reason candidates matches inliers T_map_cam sigma_m sigma_deg lines ms"
    assert list(good) == list(bad) == keys.split()
    assert good["accepted"]
    assert good["t_ns"] == 3 * reports.PERIOD_NS
    assert np.shape(good["T_map_cam"]) == (4, 4)
    assert good["sigma_m"] == pytest.approx(
        np.sqrt(np.linalg.eigvalsh(reports.covariance()[:3, :3])[-1])
    )
    assert not bad["accepted"]
    assert bad["T_map_cam"] is bad["sigma_m"] is None


def test_points_lie_where_the_keyframe_saw_them(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    data = (tmp_path / "run" / "points.ply").read_bytes()
    header, _, body = data.partition(b"end_header\n")
    assert b"element vertex 000000000100\n" in header  # two keyframes of 50
    rows = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    assert len(rows) == 100
    report = reports.report(1)
    assert report.pose is not None
    p_cam = se3.transform(se3.inverse(report.pose.T_map_cam), rows["xyz"][:50].astype(float))
    assert np.allclose(p_cam[:, 2], 2.0, atol=1e-5)
    uv = p_cam[:, :2] / p_cam[:, 2:] * 50.0 + [31.5, 23.5]
    assert np.allclose(uv, reports.keyframe(1).depth.pixels, atol=1e-3)
    assert (rows["rgb"] == 77).all()


def test_earlier_run_is_replaced_as_a_whole(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    (tmp_path / "run" / "picture.png").write_bytes(b"")
    write_run(tmp_path / "run", frames=2)
    assert {file.name for file in (tmp_path / "run").iterdir()} == CONTRACT
    assert (tmp_path / "run" / "frames.csv").read_text().count("\n") == 3
    assert list(tmp_path.iterdir()) == [tmp_path / "run"]


def test_earlier_run_survives_an_aborted_one(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    before = {file: file.read_bytes() for file in (tmp_path / "run").iterdir()}
    folder = RunFolder(tmp_path / "run", CAMERA)
    folder.write(reports.report(0))
    folder.abort()
    assert {file: file.read_bytes() for file in (tmp_path / "run").iterdir()} == before
    assert list(tmp_path.iterdir()) == [tmp_path / "run"]


def test_interrupted_run_lies_beside_a_whole_one(tmp_path: Path) -> None:
    path, stopped = tmp_path / "run", STATS | {"interrupted": True}
    assert RunFolder(path, CAMERA).finish([], stopped) == path
    write_run(path)
    before = (path / "poses.tum").read_text()
    for _ in range(2):
        beside = RunFolder(path, CAMERA).finish([], stopped)
    assert (path / "poses.tum").read_text() == before
    assert beside == tmp_path / "run-interrupted"
    assert is_run_folder(beside)
    assert not is_run_folder(beside, whole=True)


def test_empty_folder_may_be_used(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    write_run(tmp_path / "run")
    assert is_run_folder(tmp_path / "run")


def test_the_folder_that_one_is_in_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OutputError, match="the folder that you are in"):
        RunFolder(Path(), CAMERA)
    assert list(tmp_path.iterdir()) == []


def test_link_to_a_folder_is_followed(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "disk")
    write_run(tmp_path / "run")
    assert (tmp_path / "run").is_symlink()
    assert is_run_folder(tmp_path / "disk")


def test_what_a_killed_run_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / ".run.part-999999999").mkdir()
    write_run(tmp_path / "run")
    assert list(tmp_path.iterdir()) == [tmp_path / "run"]


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_foreign_things_are_left_alone(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "thesis"
    if kind == "folder":
        path.mkdir()
        (path / "chapter.txt").write_text("years of work")
    else:
        path.write_text("years of work")
    with pytest.raises(OutputError, match="name a new"):
        RunFolder(path, CAMERA)
    assert list(tmp_path.rglob("*.part*")) == []
    assert "years of work" in (path / "chapter.txt" if kind == "folder" else path).read_text()


def test_place_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError) as caught:
        RunFolder(tmp_path / "file" / "run", CAMERA)
    assert "\n" not in str(caught.value)
