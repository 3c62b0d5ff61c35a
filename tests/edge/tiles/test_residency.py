# SPDX-License-Identifier: Apache-2.0
import mmap
import threading
from pathlib import Path

import numpy as np
import pytest

from edge.tiles.reader import Map, open_map
from edge.tiles.tile import Tile
from tests.maps.small_map import SmallMap, write_small_map


@pytest.fixture
def small(tmp_path: Path) -> SmallMap:
    return write_small_map(tmp_path / "small", tile_m=1.0)


def resident_bytes(folder: Path) -> int:
    """Memory of this process that files below `folder` take."""
    total, counts = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if " " in line and line.split(maxsplit=1)[0].count("-") == 1:
            counts = line.endswith(".tile") and str(folder) in line
        elif counts and line.startswith("Rss:"):
            total += int(line.split()[1]) * 1024
    return total


def read_all(opened: Map, k: int) -> list[np.ndarray]:
    """Copies of all that the map holds about keyframe `k`."""
    features, depth = opened.features(k), opened.depth_samples(k)
    points = opened.points(features.point)
    seen_by = opened.point_views(int(features.point[0]))
    arrays = [*features, *points, *opened.covisible(k), *seen_by]
    return [np.array(a) for a in (*arrays, depth.pixels, depth.inverse_depth, depth.sigma)]


# The index alone takes 40 kB a tile: it stays with the last of these bounds only.
@pytest.mark.parametrize("tiles_held", [0.5, 1.5, 3.0, 1000.0])
def test_what_is_read_stays_within_the_bound_and_the_same(
    small: SmallMap, tiles_held: float
) -> None:
    free = open_map(small.folder)
    truth = [read_all(free, k) for k in range(free.n_keyframes)]
    largest = max(tile.bytes for tile in free.tiles)
    assert len(free.tiles) >= 6
    del free
    bound = int(tiles_held * largest)

    opened = open_map(small.folder, resident_bytes=bound)
    # The tile being visited may be there alone; files end in the middle of a page.
    allowed = max(bound, largest) + len(opened.tiles) * mmap.PAGESIZE
    assert resident_bytes(small.folder) <= allowed
    for k in [*range(opened.n_keyframes), *range(opened.n_keyframes)]:
        for a, b in zip(read_all(opened, k), truth[k], strict=True):
            np.testing.assert_array_equal(a, b)
        assert resident_bytes(small.folder) <= allowed + largest  # a keyframe's points lie in two


def test_a_bound_that_becomes_smaller_holds_at_once(small: SmallMap) -> None:
    opened = open_map(small.folder)
    for k in range(opened.n_keyframes):
        read_all(opened, k)
    largest = max(tile.bytes for tile in opened.tiles)
    before = resident_bytes(small.folder)

    opened.bound(largest)
    allowed = largest + len(opened.tiles) * mmap.PAGESIZE

    assert resident_bytes(small.folder) <= min(allowed, before)
    for k in range(opened.n_keyframes):
        read_all(opened, k)
        assert resident_bytes(small.folder) <= allowed + largest


@pytest.mark.parametrize("tiles_held", [1.5, 1000.0])
def test_the_whole_map_is_searched_within_the_bound(small: SmallMap, tiles_held: float) -> None:
    largest = max(tile.bytes for tile in open_map(small.folder).tiles)
    opened = open_map(small.folder, resident_bytes=int(tiles_held * largest))
    for described in small.descriptions:
        ids, scores = opened.bow.query(described.words, 3)
        assert scores[0] == pytest.approx(1.0, abs=1e-5)
        assert len(ids) > 0
        held = resident_bytes(small.folder)
        assert held <= tiles_held * largest + len(opened.tiles) * mmap.PAGESIZE


def test_tiles_are_read_ahead_where_the_camera_is_expected_and_once(
    small: SmallMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = open_map(small.folder)
    asked: list[Path] = []
    read_ahead = Tile.read_ahead

    def noted(tile: Tile) -> None:
        asked.append(tile.path)
        read_ahead(tile)

    monkeypatch.setattr(Tile, "read_ahead", noted)
    here, away = opened.T_map_cam[3, :3, 3], opened.T_map_cam[3, :3, 3] + 1e3
    opened.expect(here)
    k_of = [np.linalg.norm(t["keyframes/T_map_cam"][:, :3, 3] - here, axis=1) for t in opened.tiles]
    near = {t.path for t, d in zip(opened.tiles, k_of, strict=True) if d.size and d.min() < 0.4}
    assert near <= set(asked)
    assert len(asked) < len(opened.tiles)
    before = len(asked)
    opened.expect(here)
    opened.expect(away)
    assert len(asked) == before
    opened.features(3)
    opened.expect(here)  # its own tile is there already
    assert len(asked) < 2 * before


def test_threads_that_visit_together_keep_the_count(small: SmallMap) -> None:
    largest = max(tile.bytes for tile in open_map(small.folder).tiles)
    opened = open_map(small.folder, resident_bytes=2 * largest)
    truth = [read_all(opened, k) for k in range(opened.n_keyframes)]
    wrong: list[int] = []

    def drive(seed: int) -> None:
        for k in np.random.default_rng(seed).integers(0, opened.n_keyframes, 60).tolist():
            same = zip(read_all(opened, k), truth[k], strict=True)
            if not all(np.array_equal(a, b) for a, b in same):
                wrong.append(k)

    threads = [threading.Thread(target=drive, args=(seed,)) for seed in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert resident_bytes(small.folder) <= 3 * largest + len(opened.tiles) * mmap.PAGESIZE
