# SPDX-License-Identifier: Apache-2.0
"""The lines of a painted wall: found, stored, and carried by every tool that rewrites maps."""

from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from edge.errors import TileError
from edge.geometry import se3
from edge.lines import kernels_associate
from edge.tiles import format as tile_format
from edge.tiles.reader import Map, open_map
from edge.tiles.tile import OPTIONAL_LAYERS
from edge.types import U8
from maps.build import BuildInput, build
from maps.content import load, select, write
from maps.merge import merge
from maps.settings import BuildSettings
from maps.verification import verify
from maps.writer import new_map_folder, write_manifest
from tests.maps.drive_folder import KnownView, write_drive
from tests.maps.wall_drive import CAMERA, WALL_SIZE_PX, WALL_Z_M, picture, poses


def boards(seed: int) -> U8:
    """A wall of boards that lean, with a little grain."""
    rng = np.random.default_rng(seed)
    width, height = WALL_SIZE_PX
    image = np.full((height, width), 120.0, np.float32)
    for _ in range(60):
        centre = rng.uniform(0.15, 0.85, 2) * WALL_SIZE_PX
        corners = centre + rng.uniform(30.0, 110.0, (4, 2)) * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
        cv2.fillPoly(image, [np.round(corners).astype(np.int32)], float(rng.uniform(20.0, 235.0)))
    image += cv2.resize(
        rng.normal(0.0, 6.0, (height // 4, width // 4)).astype(np.float32), (width, height)
    )
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lines")
    paint = boards(7)
    shown = (KnownView(picture(paint, T), T) for T in poses(9))
    drive = write_drive(folder / "wall", CAMERA, shown, first_s=1.0)
    settings = BuildSettings(tile_m=0.4, lines=True, similar_views=4)
    build(BuildInput([drive]), folder / "map", settings)
    return folder / "map"


def everything(opened: Map) -> np.ndarray:
    return np.arange(opened.lines.count, dtype=np.int32)


def read_lines(folder: Path) -> None:
    opened = open_map(folder)
    for k in range(opened.n_keyframes):
        opened.lines.take(opened.lines.seen_by(k))


def references(opened: Map) -> int:
    return sum(len(opened.lines.seen_by(k)) for k in range(opened.n_keyframes))


def test_lines_lie_on_the_wall_within_their_covariance(built: Path) -> None:
    opened = open_map(built)
    assert len(opened.tiles) > 1
    found = opened.lines.take(everything(opened))
    assert len(found.span) > 25
    ends = found.lines.point[:, None] + found.span[:, :, None] * found.lines.direction[:, None]
    off = ends[:, :, 2] - WALL_Z_M
    assert np.median(np.abs(off)) < 0.02
    variance = np.einsum("nii->n", found.lines.covariance[:, :2, :2])
    tilt = np.einsum("nii->n", found.lines.covariance[:, 2:, 2:])
    sigma = np.sqrt(variance[:, None] + tilt[:, None] * found.span**2)
    assert np.mean(np.abs(off) < 3.0 * sigma) > 0.9


def test_keyframes_see_their_lines_where_they_are(built: Path) -> None:
    opened = open_map(built)
    seen = [opened.lines.seen_by(k) for k in range(opened.n_keyframes)]
    counts = np.bincount(np.concatenate(seen), minlength=opened.lines.count)
    assert np.array_equal(counts, opened.lines.take(everything(opened)).n_views)
    assert counts.min() >= 3
    for k, rows in enumerate(seen):
        found = opened.lines.take(rows)
        ends = found.lines.point[:, None] + found.span[:, :, None] * found.lines.direction[:, None]
        projected = np.empty((len(rows), 4))
        T = se3.inverse(opened.pose(k))
        kernels_associate.project(ends[:, 0], ends[:, 1], T, CAMERA.pinhole, 0.0, projected)
        assert np.isfinite(projected).all()


def test_written_again_it_is_the_same_to_the_byte(built: Path, tmp_path: Path) -> None:
    opened = open_map(built)
    written = write(load(opened), opened.manifest, tmp_path / "again")
    assert [t.sha256 for t in written.tiles] == [t.sha256 for t in opened.manifest.tiles]
    assert sum(tile.lines for tile in written.tiles) == opened.lines.count
    verify(tmp_path / "again")


def test_a_part_of_a_map_keeps_the_lines_that_it_sees(built: Path, tmp_path: Path) -> None:
    opened = open_map(built)
    kept = [0, 3, 4, 8]
    write(select(load(opened), kept), opened.manifest, tmp_path / "part")
    verify(tmp_path / "part")
    part = open_map(tmp_path / "part")
    sources = opened.keyframe_source[:, 1].tolist()
    for k in range(part.n_keyframes):
        before = sources.index(int(part.keyframe_source[k, 1]))
        one = opened.lines.take(opened.lines.seen_by(before))
        other = part.lines.take(part.lines.seen_by(k))
        assert len(one.span) == len(other.span) > 0
        for a, b in zip(one.lines, other.lines, strict=True):
            assert np.allclose(np.sort(a, axis=0), np.sort(b, axis=0), atol=1e-6)
    assert part.lines.count < opened.lines.count


def test_two_maps_in_one_hold_the_lines_of_both(built: Path, tmp_path: Path) -> None:
    opened = open_map(built)
    content = load(opened)
    write(select(content, [0, 1, 2, 3]), opened.manifest, tmp_path / "a")
    write(select(content, [4, 5, 6, 7, 8])._replace(extra={}), opened.manifest, tmp_path / "b")
    first = open_map(tmp_path / "a").lines.count
    for one, other in (("a", "b"), ("b", "a")):
        merge(tmp_path / one, tmp_path / other, tmp_path / "both")
        verify(tmp_path / "both")
        assert open_map(tmp_path / "both").lines.count == first > 0
    merge(tmp_path / "a", tmp_path / "a", tmp_path / "both")
    both, one = open_map(tmp_path / "both"), open_map(tmp_path / "a")
    assert both.lines.count == first
    assert references(both) == 2 * references(one)


@pytest.mark.parametrize("name", sorted(OPTIONAL_LAYERS["lines"]))
def test_damaged_lines_are_refused_by_name(built: Path, tmp_path: Path, name: str) -> None:
    opened = open_map(built)
    # The first tile owns the lines, the last one only sees some of them.
    which = len(opened.tiles) - 1 if name == "lines/link" else 0
    entry = opened.manifest.tiles[which]
    arrays = {key: np.array(array) for key, array in opened.tiles[which].layers.items()}
    values = arrays[name]
    if name in ("lines/offsets", "lines/n_views"):
        arrays[name] = values[:-1]
    elif values.dtype.kind == "f":
        values[0] = np.nan
    else:
        values[...] = 1_000_000
    folder = tmp_path / "damaged"
    with new_map_folder(folder) as partial:
        for other in opened.manifest.tiles:
            (partial / other.path).write_bytes((built / other.path).read_bytes())
        data = tile_format.encode(arrays)
        (partial / entry.path).write_bytes(data)
        tiles = list(opened.manifest.tiles)
        tiles[which] = msgspec.structs.replace(entry, bytes=len(data))
        write_manifest(partial, msgspec.structs.replace(opened.manifest, tiles=tiles))
    with pytest.raises(TileError, match=r"\.tile"):
        read_lines(folder)


def test_readers_that_know_of_no_lines_read_the_rest(built: Path) -> None:
    opened = open_map(built)
    names = list(opened.tiles[0].layers)
    first = min(names.index(name) for name in OPTIONAL_LAYERS["lines"])
    assert all(name.startswith(("lines/", "labels/")) for name in names[first:])


def test_a_map_without_lines_has_none(built: Path, tmp_path: Path) -> None:
    opened = open_map(built)
    write(load(opened)._replace(extra={}), opened.manifest, tmp_path / "points")
    points = open_map(tmp_path / "points")
    assert points.lines.count == 0
    assert len(points.lines.seen_by(0)) == 0
    with pytest.raises(IndexError):
        points.lines.take(np.array([0]))
    with pytest.raises(IndexError):
        opened.lines.seen_by(opened.n_keyframes)
