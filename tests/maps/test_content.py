# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.tiles.reader import open_map
from maps.content import load, select, write
from maps.verification import verify
from tests.maps.small_map import SmallMap, write_small_map


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> SmallMap:
    return write_small_map(tmp_path_factory.mktemp("maps") / "small")


def test_a_map_written_again_is_the_same_to_the_byte(small: SmallMap, tmp_path: Path) -> None:
    opened = open_map(small.folder)
    written = write(load(opened), opened.manifest, tmp_path / "again")
    assert len(written.tiles) > 2
    for before, after in zip(opened.manifest.tiles, written.tiles, strict=True):
        assert before.sha256 == after.sha256


def test_the_order_of_the_images_outlasts_that_of_the_tiles(
    small: SmallMap, tmp_path: Path
) -> None:
    opened = open_map(small.folder)
    content = load(opened)
    T = np.diag((-1.0, 1.0, -1.0, 1.0))  # what was first along x is last
    turned = content._replace(
        views=[view._replace(T_map_cam=T @ view.T_map_cam) for view in content.views],
        points=content.points._replace(xyz=content.points.xyz @ T[:3, :3]),
    )
    first = write(turned, opened.manifest, tmp_path / "turned")
    again = load(open_map(tmp_path / "turned"))
    assert [view.image for view in again.views] == [view.image for view in content.views]
    second = write(again, first, tmp_path / "again")
    assert [tile.sha256 for tile in first.tiles] == [tile.sha256 for tile in second.tiles]


def test_a_part_of_a_map_holds_what_its_keyframes_see(small: SmallMap, tmp_path: Path) -> None:
    opened = open_map(small.folder)
    content = load(opened)
    kept = [0, 1, 4]
    write(select(content, kept), opened.manifest, tmp_path / "part")
    verify(tmp_path / "part")
    part = open_map(tmp_path / "part")
    assert part.keyframe_source[:, 1].tolist() == [0, 10, 40]
    for new, old in enumerate(kept):
        before, after = opened.features(old), part.features(new)
        assert np.array_equal(before.descriptors, after.descriptors)
        assert np.allclose(opened.points(before.point).xyz, part.points(after.point).xyz, atol=1e-6)
        assert np.array_equal(opened.depth_samples(old).pixels, part.depth_samples(new).pixels)
        score = part.bow.scores(content.descriptions[old].words)[new]
        assert score == pytest.approx(1.0, abs=1e-5)
