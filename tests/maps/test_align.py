# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from edge.cli import main
from edge.errors import ConfigError, RecordingError, TileError
from edge.geometry import se3
from edge.tiles.reader import open_map, read_manifest
from edge.types import F64
from maps.align import SIGNATURE_NAME, by_marker, by_points, by_up, recordings_of, write_alignment
from maps.build import BuildInput, build
from maps.settings import BuildSettings
from maps.verification import verify
from maps.writer import write_manifest
from tests.maps import wall_drive
from tests.maps.small_map import SmallMap, write_small_map
from tests.maps.wall_drive import CAMERA, WALL_SIZE_PX, WALL_Z_M, write_wall_drive


@pytest.fixture
def small(tmp_path: Path) -> SmallMap:
    return write_small_map(tmp_path / "small")


def image_of_line(k: int, point: F64) -> str:
    """A line's end: the small map's camera `k`, and where it sees the point."""
    centre = np.array((1.0 * k, 0.1 * k, 0.0))
    x, y, z = point - centre
    u, v = CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy
    return f"in {10 * k} {u:.4f} {v:.4f}"


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -2), (0, -1, 0), (0.3, -0.9, 0.1)])
def test_up_becomes_z_and_the_origin_stays(up: tuple[float, ...]) -> None:
    T = by_up(np.array(up)).T_local_map
    turned = T[:3, :3] @ np.array(up) / np.linalg.norm(up)
    assert np.allclose(turned, (0, 0, 1), atol=1e-12)
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) > 0
    assert np.allclose(T[:3, 3], 0)


@pytest.mark.parametrize("up", [(0, 0, 0), (np.nan, 0, 1), (1e308, 1e308, 0)])
def test_no_direction_is_refused(up: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match="--up"):
        by_up(np.array(up))


def test_surveyed_points_place_the_map_however_they_were_found(small: SmallMap) -> None:
    T = se3.exp((3.0, -2.0, 1.0, 1.2, -0.4, 0.3))
    in_map = np.array([(0, 0, 3.0), (2.0, 0.3, 2.5), (4.0, -0.5, 3.5), (1.0, 1.0, 2.0)])
    lines = ["# survey of the yard", ""]
    for number, point in enumerate(in_map):
        surveyed = " ".join(f"{value:.6f}" for value in se3.transform(T, point[None])[0])
        if number == 1:
            lines += [f"{surveyed} {image_of_line(k, point)}" for k in (1, 2, 3)]
        else:
            lines.append(f"{surveyed} at {' '.join(map(str, point))}  # a corner")
    path = small.folder.parent / "survey.txt"
    path.write_text("\n".join(lines), encoding="utf-8-sig")  # as Windows' editors do
    found = by_points(open_map(small.folder), path)
    assert np.allclose(found.T_local_map, T, atol=1e-4)
    assert "4 surveyed points" in found.how


LEVEL = ((0, 0.1, 2), (3, 0.1, 2), (1, 0.1, 5), (3, 0.1, 4))  # in the map, whose y points down


@pytest.mark.parametrize(
    ("in_map", "swapped", "said"),
    [(LEVEL, False, False), (LEVEL, True, True), ((*LEVEL[:3], (3, -1, 4)), False, False)],
    ids=["level", "level and swapped", "one higher"],
)
def test_a_level_survey_with_swapped_axes_is_told_by_the_images(
    small: SmallMap,
    caplog: pytest.LogCaptureFixture,
    in_map: tuple[tuple[float, ...], ...],
    swapped: bool,
    said: bool,
) -> None:
    path = small.folder.parent / "survey.txt"
    surveyed = ((z, x, -y) if swapped else (x, z, -y) for x, y, z in in_map)
    rows = zip(surveyed, in_map, strict=True)
    path.write_text(
        "\n".join(f"{' '.join(map(str, s))} at {' '.join(map(str, m))}" for s, m in rows)
    )

    by_points(open_map(small.folder), path)

    assert ("stand on their heads" in caplog.text) == said


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("1 2 3 at 1 2 3\n4 5 6 at 4 5 6", "2 points are too few"),
        ("0 0 0 at 0 0 0\n1 0 0 at 1 0 0\n2 0 0 at 2 0 0", "on one line"),
        ("\n".join(["2 3 4 at 2 3 4"] * 3), "on one line"),
        ("0 0 0 at 0 0 0\n1 0 0 at 1 0 0\n0 9 0 at 0 1 0", "from its place"),
        ("0 0 0 on 0 0 0", "line 1: is no surveyed point"),
        ("\n0 0 0 at 0 0 x", "line 2: holds something that is no number"),
        ("0 0 0 at 0 0 inf", "line 1: holds a number that is no possible length"),
        ("1e308 0 0 at 0 0 0", "line 1: holds a number that is no possible length"),
        ("0 0 0 in 7 0 0", "image 7 is no keyframe"),
        ("0 0 0 in 10 5 5", "from one side only"),
        ("0 0 0 in 10 5 5\n0 0 0 in 40 200 200", "miss each other"),
        ("0 0 0 in 10 265 139.5\n0 0 0 in 30 57 158.5", "miss each other by [12]. px"),
    ],
)
def test_a_wrong_survey_is_refused(small: SmallMap, text: str, complaint: str) -> None:
    path = small.folder.parent / "survey.txt"
    path.write_text(text)
    with pytest.raises(ConfigError, match=rf"survey\.txt.*{complaint}"):
        by_points(open_map(small.folder), path)


def test_a_map_without_metres_is_not_placed_by_points(small: SmallMap) -> None:
    manifest = msgspec.structs.replace(read_manifest(small.folder), metric=False)
    (small.folder / "manifest.json").unlink()
    write_manifest(small.folder, manifest)
    with pytest.raises(TileError, match="not in metres"):
        by_points(open_map(small.folder), small.folder / "none.txt")


def test_an_aligned_map_is_the_same_but_for_its_place_and_signature(small: SmallMap) -> None:
    before = read_manifest(small.folder)
    alignment = by_up(np.array((0.0, -1.0, 0.0)))
    assert not write_alignment(small.folder, alignment)
    (small.folder / SIGNATURE_NAME).write_bytes(bytes(64))
    assert write_alignment(small.folder, alignment)
    assert not (small.folder / SIGNATURE_NAME).exists()
    verify(small.folder)
    after = read_manifest(small.folder)
    assert np.allclose(np.array(after.T_local_map), alignment.T_local_map)
    assert msgspec.structs.replace(after, T_local_map=None) == before
    assert sorted(path.name for path in small.folder.iterdir()) == ["manifest.json", "tiles"]


MARKER_PX = 80


def marked_wall() -> np.ndarray:
    """The wall with marker 7 on a white card in its middle."""
    paint = wall_drive.wall()
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)
    w, h = WALL_SIZE_PX
    half = MARKER_PX // 2
    paint[h // 2 - 60 : h // 2 + 60, w // 2 - 60 : w // 2 + 60] = 255
    paint[h // 2 - half : h // 2 + half, w // 2 - half : w // 2 + half] = (
        cv2.aruco.generateImageMarker(dictionary, 7, MARKER_PX)
    )
    return paint


def test_a_marker_on_the_wall_becomes_the_origin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = write_wall_drive(tmp_path / "wall", 6)
    paint = marked_wall()
    for i, T in enumerate(wall_drive.poses(6)):
        cv2.imwrite(str(drive / "rgb" / f"{i:04d}.png"), wall_drive.picture(paint, T))
    build(BuildInput([drive]), tmp_path / "map", BuildSettings(lens="given"))
    opened = open_map(tmp_path / "map")
    (tmp_path / "here" / "wall").mkdir(parents=True)  # of the same name, but no recording
    monkeypatch.chdir(tmp_path / "here")
    # Found by its name beside the map. The wall lies at z = 2, seen with y downwards.
    found = by_marker(opened, 7, "APRILTAG_36H11", on_wall=True, recordings=[])
    origin = se3.transform(found.T_local_map, np.array([[0.0, 0.0, WALL_Z_M]]))
    assert np.allclose(origin, 0.0, atol=0.01)
    turned = found.T_local_map[:3, :3] @ np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1.0]]).T
    # Right on the print is x, up on it z, and y goes into the wall.
    assert np.allclose(turned, np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0]]).T, atol=0.02)
    floor = by_marker(opened, 7, "APRILTAG_36H11", on_wall=False, recordings=[drive])
    assert np.allclose(floor.T_local_map[:3, :3] @ (0, 0, -1), (0, 0, 1), atol=0.02)
    with pytest.raises(RecordingError, match="--marker 8: is not seen"):
        by_marker(opened, 8, "APRILTAG_36H11", on_wall=True, recordings=[drive])


def test_a_recording_file_is_found_by_its_name_too(small: SmallMap, tmp_path: Path) -> None:
    walk = tmp_path / "walk.mcap"
    assert main(["record", str(write_wall_drive(tmp_path / "wall", 2)), "--out", str(walk)]) == 0
    manifest = msgspec.structs.replace(read_manifest(small.folder), sequences=["walk.mcap"])
    (small.folder / "manifest.json").unlink()
    write_manifest(small.folder, manifest)
    (found,) = recordings_of(open_map(small.folder), [])
    assert len(found.indices) == 2


def test_images_that_cannot_be_guessed_are_asked_for(small: SmallMap) -> None:
    with pytest.raises(RecordingError, match=r"sequence made up are needed.*--images"):
        by_marker(open_map(small.folder), 1, "APRILTAG_36H11", on_wall=True, recordings=[])
