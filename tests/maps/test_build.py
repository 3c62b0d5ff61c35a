# SPDX-License-Identifier: Apache-2.0
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.errors import OutputError, RecordingError, TileError
from edge.geometry import se3
from edge.tiles.reader import open_map
from maps.build import BuildInput, BuildReport, build
from maps.settings import BuildSettings
from maps.verification import verify
from maps.writer import new_map_folder
from tests.maps import wall_drive
from tests.maps.wall_drive import WALL_Z_M, write_wall_drive

SETTINGS = BuildSettings(tile_m=0.3)


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_wall_drive(tmp_path_factory.mktemp("drives") / "wall")


@pytest.fixture(scope="module")
def built(drive: Path) -> tuple[Path, BuildReport]:
    out = drive.parent / "map"
    return out, build(BuildInput([drive]), out, SETTINGS)


def test_points_lie_on_the_wall_within_their_covariance(built: tuple[Path, BuildReport]) -> None:
    opened = open_map(built[0])
    points = opened.points(np.arange(opened.n_points, dtype=np.int32))
    assert opened.n_points > 500
    off = (points.xyz[:, 2] - WALL_Z_M) / np.sqrt(points.covariance[:, 2, 2])
    assert np.median(np.abs(points.xyz[:, 2] - WALL_Z_M)) < 0.015
    # The median of a unit normal's size is 0.67.
    assert 0.2 < np.median(np.abs(off)) < 0.95
    assert np.mean(np.abs(off) < 3.0) > 0.94


def test_it_verifies_and_its_tiles_follow_the_keyframes(built: tuple[Path, BuildReport]) -> None:
    out, report = built
    checked = verify(out)
    assert checked.tiles == len(report.manifest.tiles) > 1
    assert checked.keyframes == 6
    for tile in open_map(out).tiles:
        centres = tile["keyframes/T_map_cam"][:, :3, 3]
        assert (np.round(centres / SETTINGS.tile_m) == tile.entry.cell).all()


def test_features_of_keyframes_project_where_they_were_seen(
    built: tuple[Path, BuildReport],
) -> None:
    opened = open_map(built[0])
    camera = opened.camera
    for k in range(opened.n_keyframes):
        features = opened.features(k)
        T = se3.inverse(opened.pose(k))
        xyz = opened.points(features.point).xyz @ T[:3, :3].T + T[:3, 3]
        seen = xyz[:, :2] / xyz[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        off = np.linalg.norm(seen - features.pixels, axis=1) / 1.2**features.octave
        assert np.median(off) < 0.5


@pytest.mark.slow
def test_any_number_of_workers_gives_the_same_bytes(
    drive: Path, built: tuple[Path, BuildReport], tmp_path: Path
) -> None:
    build(BuildInput([drive]), tmp_path / "two", SETTINGS, workers=2)
    assert files(tmp_path / "two") == files(built[0])


def test_given_depth_makes_points_of_single_views_and_samples(tmp_path: Path) -> None:
    drive = write_wall_drive(tmp_path / "wall", 3, with_depth=True)
    build(BuildInput([drive]), tmp_path / "map", BuildSettings(), workers=1)
    opened = open_map(tmp_path / "map")
    verify(tmp_path / "map")
    points = opened.points(np.arange(opened.n_points, dtype=np.int32))
    alone = points.n_views == 1
    assert alone.sum() > 20
    assert np.abs(points.xyz[:, 2] - WALL_Z_M).max() < 0.06
    off = (points.xyz[:, 2] - WALL_Z_M) / np.sqrt(points.covariance[:, 2, 2])
    assert np.mean(np.abs(off) < 3.0) > 0.99
    samples = opened.depth_samples(1)
    assert len(samples.pixels) > 200
    u, v = np.round(samples.pixels).astype(int).T
    truth = 1.0 / wall_drive.depth(opened.pose(1))[v, u]
    assert np.abs(samples.inverse_depth - truth).max() < 0.002


def test_depth_can_be_left_aside(tmp_path: Path) -> None:
    drive = write_wall_drive(tmp_path / "wall", 3, with_depth=True)
    build(BuildInput([drive]), tmp_path / "map", BuildSettings(depth="none"))
    opened = open_map(tmp_path / "map")
    assert len(opened.depth_samples(0).pixels) == 0
    assert opened.points(np.arange(opened.n_points, dtype=np.int32)).n_views.min() > 1


def test_excluded_and_unchosen_images_are_left_out(drive: Path, tmp_path: Path) -> None:
    source = BuildInput([drive], slice(1, 6), 2, frozenset({3}))
    build(source, tmp_path / "map", SETTINGS)
    assert open_map(tmp_path / "map").keyframe_source.tolist() == [[0, 1], [0, 5]]


def test_two_sequences_of_one_frame_join(tmp_path: Path) -> None:
    drives = [write_wall_drive(tmp_path / name, 4) for name in ("first", "second")]
    report = build(BuildInput(drives), tmp_path / "map", BuildSettings())
    assert report.manifest.sequences == ["first", "second"]
    opened = open_map(tmp_path / "map")
    assert opened.n_keyframes == 8
    _, features = opened.covisible(0), opened.features(0)
    seen = opened.keyframe_source[opened.point_views(int(features.point[0]))[0], 0]
    assert set(seen.tolist()) == {0, 1}


def test_a_recording_that_comes_twice_is_refused(tmp_path: Path) -> None:
    root = write_wall_drive(tmp_path / "wall", 2)
    (tmp_path / "other").symlink_to(root)
    for again in (root, tmp_path / "other", root / ".." / "wall"):
        with pytest.raises(RecordingError, match="is named twice"):
            build(BuildInput([root, again]), tmp_path / "map", BuildSettings())
    assert not (tmp_path / "map").exists()


def test_a_map_is_not_built_over_its_recording(tmp_path: Path) -> None:
    site = tmp_path / "site"
    root = write_wall_drive(site / "walk", 2)
    (site / "manifest.json").write_text("{}")  # so that it passes for an earlier map
    with pytest.raises(OutputError, match="holds what is to be read"):
        build(BuildInput([root]), site, BuildSettings())
    assert (root / "rgb.txt").is_file()


def test_a_recording_without_poses_is_refused(tmp_path: Path) -> None:
    drive = write_wall_drive(tmp_path / "wall", 2, with_poses=False)
    with pytest.raises(RecordingError, match=r"no poses.*groundtruth\.txt"):
        build(BuildInput([drive]), tmp_path / "map", SETTINGS)
    assert not (tmp_path / "map").exists()


def test_poses_of_another_time_are_refused(tmp_path: Path) -> None:
    drive = write_wall_drive(tmp_path / "wall", 2)
    (drive / "groundtruth.txt").write_text("5.0 0 0 0 0 0 0 1\n6.0 0 0 0 0 0 0 1\n")
    with pytest.raises(RecordingError, match="no chosen image has a pose"):
        build(BuildInput([drive]), tmp_path / "map", SETTINGS)


@pytest.mark.parametrize(
    "row",
    ["100.0 nan 0 0 0 0 0 1", "100.0 0 0 0 0 0 0 0", "100.0 1 2", "100.0 -2e9 0 0 0 0 0 1"],
)
def test_a_pose_that_is_none_is_refused(tmp_path: Path, row: str) -> None:
    drive = write_wall_drive(tmp_path / "wall", 2)
    (drive / "groundtruth.txt").write_text(row + "\n100.1 0 0 0 0 0 0 1\n")
    with pytest.raises(RecordingError, match=r"groundtruth\.txt"):
        build(BuildInput([drive]), tmp_path / "map", SETTINGS)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_an_image_that_cannot_be_read_is_named_and_nothing_stays(
    tmp_path: Path, workers: int
) -> None:
    drive = write_wall_drive(tmp_path / "wall", 3)
    (drive / "rgb" / "0001.png").write_bytes(b"no picture")
    with pytest.raises(RecordingError, match=r"0001\.png: .*--exclude 1$"):
        build(BuildInput([drive]), tmp_path / "map", SETTINGS, workers=workers)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["wall"]


def test_images_that_show_nothing_are_refused(tmp_path: Path) -> None:
    drive = write_wall_drive(tmp_path / "wall", 2)
    for name in ("0000.png", "0001.png"):
        cv2.imwrite(str(drive / "rgb" / name), np.full((240, 320), 90, np.uint8))
    with pytest.raises(RecordingError, match="no point"):
        build(BuildInput([drive]), tmp_path / "map", SETTINGS)
    assert not (tmp_path / "map").exists()


def test_a_map_is_replaced_but_nothing_else_is(
    drive: Path, built: tuple[Path, BuildReport], tmp_path: Path
) -> None:
    out = tmp_path / "map"
    build(BuildInput([drive], slice(0, 3)), out, SETTINGS)
    build(BuildInput([drive]), out, SETTINGS)
    assert files(out) == files(built[0])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map"]
    for place, content in ((tmp_path / "notes", "dear diary"), (tmp_path / "full" / "a", "b")):
        place.parent.mkdir(exist_ok=True)
        place.write_text(content)
    for target in (tmp_path / "notes", tmp_path / "full"):
        with pytest.raises(OutputError, match=str(target)):
            build(BuildInput([drive]), target, SETTINGS)
    assert (tmp_path / "notes").read_text() == "dear diary"


def test_the_folder_that_one_is_in_is_refused_before_any_work(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OutputError, match="the folder that you are in"):
        build(BuildInput([drive]), Path(), SETTINGS)
    assert list(tmp_path.iterdir()) == []


def wait_for_results(process: "subprocess.Popen[bytes]", work: Path, count: int) -> None:
    """Until so many results are kept, or the build is over: time tells nothing of how far it is."""
    while process.poll() is None:
        if count == 0 or (work.is_dir() and len(list(work.iterdir())) >= count):
            return
        time.sleep(0.005)


@pytest.mark.slow
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize("results", [0, 1, 11])
def test_a_build_stopped_at_any_moment_leaves_no_half_map(
    drive: Path, tmp_path: Path, sign: signal.Signals, results: int
) -> None:
    out = tmp_path / "map"
    command = [sys.executable, "-m", "maps.cli", "build", str(drive), "--out", str(out)]
    process = subprocess.Popen([*command, "--workers", "2"], stderr=subprocess.PIPE)
    wait_for_results(process, tmp_path / ".map.work", results)
    process.send_signal(sign)
    _, said = process.communicate(timeout=300.0)
    for left in tmp_path.iterdir():
        assert left.name == "map" or left.name.startswith(".map")
        if (left / "manifest.json").exists():
            verify(left)
    if process.returncode == 130:
        assert b"mapvo-map: stopped; the same command goes on from here\n" in said
    elif not out.exists():  # killed, or told to end before Python could listen
        assert process.returncode != 0


@pytest.mark.slow
def test_a_killed_build_goes_on_and_ends_the_same(
    drive: Path, built: tuple[Path, BuildReport], tmp_path: Path
) -> None:
    out, work = tmp_path / "map", tmp_path / ".map.work"
    command = [sys.executable, "-m", "maps.cli", "build", str(drive), "--out", str(out)]
    process = subprocess.Popen([*command, "--tile-m", "0.3"], stderr=subprocess.PIPE)
    wait_for_results(process, work, 1)
    process.kill()
    process.communicate()
    build(BuildInput([drive]), out, SETTINGS)
    assert files(out) == files(built[0])
    assert [path.name for path in tmp_path.iterdir()] == ["map"]


@pytest.mark.parametrize("there", [True, False])
def test_a_map_is_put_where_a_link_leads(
    drive: Path, built: tuple[Path, BuildReport], tmp_path: Path, there: bool
) -> None:
    place, link = tmp_path / "place", tmp_path / "link"
    link.symlink_to(place)
    if there:
        shutil.copytree(built[0], place)
    build(BuildInput([drive]), link, SETTINGS)
    assert files(place) == files(built[0])
    assert link.readlink() == place
    assert {path.name for path in tmp_path.iterdir()} == {"place", "link"}


def test_what_is_being_written_does_not_open_and_vanishes_on_an_error(tmp_path: Path) -> None:
    def write_and_fail() -> None:
        with new_map_folder(tmp_path / "map") as partial:
            (partial / "tiles" / "a.tile").write_bytes(b"half")
            assert partial.parent == tmp_path
            assert partial.name.startswith(".")
            with pytest.raises(TileError, match="no map"):
                open_map(partial)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_and_fail()
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_writer_left_goes_and_what_another_is_writing_stays(tmp_path: Path) -> None:
    program = (
        "import os, pathlib, sys; from maps.writer import new_map_folder\n"
        "with new_map_folder(pathlib.Path(sys.argv[1])) as partial:\n"
        "    (partial / 'tiles' / 'a.tile').write_bytes(b'half')\n"
        "    print(partial, flush=True)\n"
        "    sys.stdin.read()"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "map")]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    there = Path(process.stdout.readline().strip())
    with new_map_folder(tmp_path / "map") as own:
        (own / "manifest.json").touch()
    assert there.exists()
    process.kill()
    process.communicate()
    assert there.exists()
    with new_map_folder(tmp_path / "map"):
        assert not there.exists()
