# SPDX-License-Identifier: Apache-2.0
import json
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.geometry import se3
from edge.tiles.reader import Map, open_map
from maps.build import BuildInput, build
from maps.cli import main
from maps.scale import parse
from maps.settings import BuildSettings
from maps.survey import Survey
from tests.maps import other_formats
from tests.maps.other_formats import COLMAP_UNIT_M, WRITERS, Frames
from tests.maps.posters import MARKER_SIDE_M, path, write_posters

WALK = 6
SETTINGS = BuildSettings(depth="none", lens="given")


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def frames() -> Frames:
    return other_formats.frames()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory, frames: Frames) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("formats")
    for name, (write, _) in WRITERS.items():
        write(base / name, frames)
    places = {name: base / name / below for name, (_, below) in WRITERS.items()}
    places["without-poses"] = base / "without-poses"
    shutil.copytree(places["tum"], places["without-poses"])
    (places["without-poses"] / "groundtruth.txt").unlink()
    return places


def poster_distances(opened: Map, unit_m: float) -> np.ndarray:
    """How far points lie from the posters, as a part of their distance."""
    z = opened.points(np.arange(opened.n_points, dtype=np.int32)).xyz[:, 2] * unit_m
    planes = np.array([2.6, 2.1, 1.7, 1.9])
    return np.abs(z[:, None] - planes).min(axis=1) / z


@pytest.mark.parametrize("name", list(WRITERS))
def test_each_format_builds_as_it_is(
    recordings: dict[str, Path], frames: Frames, tmp_path: Path, name: str
) -> None:
    report = build(BuildInput([recordings[name]]), tmp_path / "map", SETTINGS)
    assert report.manifest.counts.keyframes == other_formats.N
    unit_m = COLMAP_UNIT_M if name == "colmap" else 1.0
    opened = open_map(tmp_path / "map")
    for k, (_, _, T) in enumerate(frames):
        found = opened.T_map_cam[k].copy()
        found[:3, 3] *= unit_m
        np.testing.assert_allclose(found, T, atol=1e-7)
    assert np.median(poster_distances(opened, unit_m)) < 0.005
    assert report.manifest.metric == (name not in ("colmap", "nerfstudio"))


@pytest.mark.parametrize(
    ("hint", "tolerance"), [("distance:0,4=1.3", 0.03), (f"marker:4X4_50={MARKER_SIDE_M}", 0.01)]
)
def test_poses_and_depth_maps_of_a_unit_of_their_own_become_metres(
    recordings: dict[str, Path], frames: Frames, tmp_path: Path, hint: str, tolerance: float
) -> None:
    source = BuildInput([recordings["colmap"]], scale=parse(hint))
    settings = BuildSettings(depth="given", lens="given")
    report = build(source, tmp_path / "map", settings)
    assert report.manifest.metric
    opened = open_map(tmp_path / "map")
    moved = np.linalg.norm(opened.T_map_cam[4][:3, 3] - opened.T_map_cam[0][:3, 3])
    truth = np.linalg.norm(frames[4][2][:3, 3] - frames[0][2][:3, 3])
    assert moved == pytest.approx(truth, rel=tolerance)
    assert np.median(poster_distances(opened, truth / moved)) < 0.003
    samples = opened.depth_samples(2)
    u, v = np.round(samples.pixels).astype(int).T
    ratio = samples.inverse_depth * frames[2][1][v, u]
    assert len(ratio) > 100
    assert np.median(ratio) == pytest.approx(truth / moved, rel=0.003)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a walk without poses, what sfm found and the map of it."""
    base = tmp_path_factory.mktemp("found")
    write_posters(base / "walk", WALK, with_depth=True)
    command = ["build", str(base / "walk"), "--poses", "sfm", "--depth", "none"]
    assert main([*command, "--sfm", str(base / "walk.sfm"), "--out", str(base / "map")]) == 0
    return base


@pytest.mark.slow
def test_a_map_without_a_hint_says_that_it_has_no_metres(found: Path) -> None:
    manifest = open_map(found / "map").manifest
    assert not manifest.metric
    assert (manifest.build["poses"], manifest.build["scale"]) == ("sfm", "none")
    assert manifest.counts.keyframes == WALK
    T = open_map(found / "map").T_map_cam
    np.testing.assert_allclose(T[0], np.eye(4), atol=1e-12)
    assert not list(found.glob(".*"))


@pytest.mark.slow
def test_stored_poses_give_the_same_bytes_whoever_does_the_work(
    found: Path, tmp_path: Path
) -> None:
    source = BuildInput([found / "walk"], poses="sfm", sfm_file=found / "walk.sfm")
    settings = BuildSettings(depth="none")
    for workers in (1, 2):
        build(source, tmp_path / str(workers), settings, workers=workers)
        assert files(tmp_path / str(workers)) == files(found / "map")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hint", "depth"),
    [(None, "given"), ("depth", "given"), (f"marker:4X4_50={MARKER_SIDE_M}", "given")],
)
def test_depth_images_or_a_marker_make_it_metres(
    found: Path, tmp_path: Path, hint: str | None, depth: str
) -> None:
    source = BuildInput(
        [found / "walk"],
        poses="sfm",
        sfm_file=found / "walk.sfm",
        scale=None if hint is None else parse(hint),
    )
    settings = msgspec.structs.replace(BuildSettings(), depth=depth)
    report = build(source, tmp_path / "map", settings)
    assert report.manifest.metric
    T = open_map(tmp_path / "map").T_map_cam
    truth = path(WALK)
    length = np.linalg.norm(truth[-1][:3, 3] - truth[0][:3, 3])
    assert np.linalg.norm(T[-1][:3, 3]) == pytest.approx(length, rel=0.01)
    points = open_map(tmp_path / "map")
    z = se3.transform(truth[0], points.points(np.arange(points.n_points, dtype=np.int32)).xyz)
    planes = np.array([2.6, 2.1, 1.7, 1.9])
    assert np.median(np.abs(z[:, 2, None] - planes).min(axis=1)) < 0.01


@pytest.mark.slow
def test_given_poses_lend_their_frame_and_their_metres(found: Path, tmp_path: Path) -> None:
    write_posters(tmp_path / "walk", WALK, with_poses=True, order=[3, 1, 5, 0, 4, 2])
    command = ["build", str(tmp_path / "walk"), "--poses", "sfm", "--scale", "given"]
    assert main([*command, "--out", str(tmp_path / "map")]) == 0
    opened = open_map(tmp_path / "map")
    assert opened.manifest.metric
    truth = path(WALK)[[3, 1, 5, 0, 4, 2]]
    off = np.linalg.norm(opened.T_map_cam[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.006


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["tum", "--sfm", "x.sfm"], "--sfm: is for --poses sfm"),
        (["tum", "--scale", "metres"], "are in metres; leave it out"),
        (["colmap", "--scale", "given"], "--scale given: is for --poses sfm"),
        (["colmap", "--scale", "distance:0,9=1"], "image 9 is not among"),
        (["colmap", "--scale", "marker:6X6_50=1"], "no marker of the family"),
        (["nerfstudio", "--depth", "lidar"], "--depth lidar is in metres"),
        (["tum", "colmap"], "poses in metres cannot be joined"),
        (["tum", "--poses", "sfm", "--frames", "0:1"], "two images at least"),
        (["tum", "--poses", "sfm", "--scale", "metres"], "metres: is for given poses"),
        (["tum", "--poses", "sfm", "--scale", "depth", "--depth", "none"], "needs depth images"),
        (["tum", "--poses", "sfm", "--depth", "stereo"], "--depth stereo is in metres"),
        (["without-poses", "--poses", "sfm", "--scale", "given"], "fewer than two images"),
        (["tum", "--markers", "5X4_50"], "'5X4_50' is unknown"),
    ],
)
def test_what_makes_no_sense_is_one_line_before_any_work_and_leaves_nothing(
    recordings: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Survey, "describe", None)
    command = [str(recordings.get(argument, argument)) for argument in arguments]
    assert main(["build", *command, "--out", "map"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_hint_that_is_none_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["build", "walk", "--scale", "large", "--out", "map"])
    assert stopped.value.code == 2
    assert "'large' says no scale" in capsys.readouterr().err


def test_images_of_two_cameras_make_one_map(recordings: dict[str, Path], tmp_path: Path) -> None:
    root = tmp_path / "two"
    shutil.copytree(recordings["nerfstudio"], root)
    table = json.loads((root / "transforms.json").read_text())
    table["frames"][1]["fl_x"] = 260.01  # as good as the others', but a camera of its own
    (root / "transforms.json").write_text(json.dumps(table))
    report = build(BuildInput([root]), tmp_path / "map", SETTINGS)
    assert [camera.fx for camera in report.manifest.cameras] == [260.0, 260.01]
    opened = open_map(tmp_path / "map")
    assert np.median(poster_distances(opened, 1.0)) < 0.005
