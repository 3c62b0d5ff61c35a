# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.geometry import se3
from edge.lines.line import lines_between, segments_between
from edge.lines.threeview import Drawn, Posed
from maps.lines.fusion import fuse, join_segments, trusted
from maps.lines.layer import LineLayer
from maps.lines.twins import without_twins
from maps.lines.views import choose_neighbours
from maps.points import StoredPoints
from tests.maps.wall_drive import CAMERA

SIGMA_M = 0.003


def layer(first: list[list[float]], last: list[list[float]], n_views: list[int]) -> LineLayer:
    """Lines between ends, each seen by as many views as it says, from view 0 on."""
    lines = lines_between(first, last, SIGMA_M)
    half = 0.5 * np.linalg.norm(np.subtract(last, first), axis=1)
    span = np.stack((-half, half), axis=1)
    view = np.concatenate([np.arange(n, dtype=np.int32) for n in n_views])
    line = np.repeat(np.arange(len(n_views), dtype=np.int32), n_views)
    return LineLayer.of(lines, span, np.array(n_views), (view, line))


def test_pieces_of_one_line_become_one_that_all_their_views_see() -> None:
    made = without_twins(
        layer([[0, 0, 2], [0.4, 0.002, 2]], [[1, 0, 2], [1.6, 0.002, 2.002]], [5, 8])
    )
    assert len(made.point) == 1
    assert made.n_views.tolist() == [8]
    assert made.view.tolist() == list(range(8))
    ends = made.point[0] + np.outer(made.span[0], made.direction[0])
    assert np.allclose(ends, [[0, 0, 2], [1.6, 0, 2]], atol=0.01)


def test_other_lines_stay() -> None:
    apart = layer(
        [[0, 0, 2], [0, 0.03, 2], [0, 0, 2], [1.2, 0, 2], [1, 0, 2]],
        [[1, 0, 2], [1, 0.03, 2], [1, 0.1, 2], [2, 0, 2], [0, 0, 2]],
        [3, 4, 5, 6, 7],
    )  # beside it, askew, behind its end, with the brighter side on the other hand
    made = without_twins(apart)
    assert len(made.point) == 5
    for before, after in zip(apart, made, strict=True):
        assert np.array_equal(np.sort(before, axis=0), np.sort(after, axis=0))


def test_nothing_has_no_twins() -> None:
    empty = layer([[0, 0, 2]], [[1, 0, 2]], [3]).kept(np.full(3, -1), np.empty(0, np.int32))
    assert len(without_twins(empty).point) == 0


def test_lines_that_hardly_a_view_sees_are_not_trusted() -> None:
    """Of twenty views both lines should be seen by all, and are by ten and by two."""
    made = layer([[-1, 0, 2], [-1, 0.5, 2]], [[1, 0, 2], [1, 0.5, 2]], [10, 2])
    nothing = Drawn(segments_between([], 1.0), np.empty((0, 2, 6), np.float32))
    views = [Posed(nothing, se3.exp([0.01 * k, 0, 0, 0, 0, 0])) for k in range(20)]
    kept = trusted(made, views, CAMERA.pinhole)
    assert kept.n_views.tolist() == [10]
    assert kept.view.tolist() == list(range(10))
    assert len(trusted(made, views[:8], CAMERA.pinhole).point) == 2


def test_views_without_a_neighbour_give_no_lines() -> None:
    nothing = Drawn(segments_between([], 1.0), np.empty((0, 2, 6), np.float32))
    views = [Posed(nothing, np.eye(4)), Posed(nothing, np.eye(4))]
    none = np.empty(0, np.int32)
    xyz = np.empty((0, 3))
    empty = np.empty(0)
    points = StoredPoints(
        xyz, np.empty((0, 6)), empty, xyz, empty, empty, np.empty(0, np.int64),
        np.zeros(1, np.int64), none, none, none, [none, none], [none, none],
    )  # fmt: skip
    assert [others for others, _ in choose_neighbours(views, points)] == [[], []]
    matched = [np.empty((0, 0), np.int32)] * 2
    tracks = join_segments(views, [[], []], matched)
    assert tracks == []
    made = trusted(without_twins(fuse(views, tracks, CAMERA.pinhole)), views, CAMERA.pinhole)
    assert len(made.point) == 0
