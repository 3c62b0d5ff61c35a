# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.lines.line import segments_between
from edge.odometry.line_landmark import CONFIRMED_PX, MIN_VIEWS, Line, made, off_px
from edge.odometry.line_tracks import View
from edge.types import F64, Mat4, Pinhole

CAMERA = Pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
SIGMA_PX = 0.05
EDGE = np.array([[-0.8, -0.5, 3.0], [0.7, 0.4, 2.6]])


def pose(k: int) -> Mat4:
    return se3.exp(np.array([-0.1 * k, 0.05 * (-1) ** k, 0.02 * k, 0.004 * k, -0.01 * k, 0.0]))


def pixels(k: int) -> F64:
    local = se3.transform(pose(k), EDGE)
    return np.asarray(local[:, :2] / local[:, 2:] * CAMERA[2:4] + CAMERA[4:])


def view(k: int, off_px: float = 0.0, *, turned_round: bool = False) -> View:
    """The edge from pose k, moved by so much across itself."""
    ends = pixels(k)
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    ends = ends + off_px * np.array([-along[1], along[0]])
    order = [1, 0] if turned_round else [0, 1]
    return View(segments_between(ends[order].reshape(1, 4), SIGMA_PX), 0, None, pose(k))


def line_of(n: int) -> Line:
    line = made([view(k) for k in range(n)], CAMERA)
    assert line is not None
    return line


def away_m(line: Line) -> float:
    """Of the edge's ends from the line."""
    return float(np.max(np.linalg.norm(np.cross(EDGE - line.point, line.direction), axis=1)))


@pytest.mark.parametrize("turned_round", [False, True])
def test_a_line_runs_where_and_as_its_views_do(turned_round: bool) -> None:
    line = made([view(k, turned_round=turned_round) for k in range(MIN_VIEWS)], CAMERA)
    assert line is not None
    assert away_m(line) < 1e-6
    truly = (EDGE[1] - EDGE[0]) / np.linalg.norm(EDGE[1] - EDGE[0])
    assert line.direction @ truly == pytest.approx(-1.0 if turned_round else 1.0)
    shown = line.point + line.span[:, None] * line.direction
    np.testing.assert_allclose(shown, EDGE[::-1] if turned_round else EDGE, atol=1e-5)


def test_three_views_make_a_line_and_a_fourth_one_makes_it_trusted() -> None:
    line = line_of(MIN_VIEWS)
    assert line.try_out(CAMERA)
    assert not line.is_trusted
    line.views.append(view(MIN_VIEWS, 0.1))
    assert line.try_out(CAMERA)
    assert line.is_trusted


def test_a_line_that_its_next_views_do_not_confirm_goes_untrusted() -> None:
    line = line_of(MIN_VIEWS)
    before = line.point.copy()
    line.views.append(view(MIN_VIEWS, 4.0))
    assert line.try_out(CAMERA)  # once may be chance
    np.testing.assert_array_equal(line.point, before)
    line.views.append(view(MIN_VIEWS + 1, 4.0))
    assert not line.try_out(CAMERA)
    assert not line.is_trusted


def test_views_of_two_edges_make_no_line() -> None:
    assert made([view(0), view(1, 6.0), view(2, -6.0), view(3)], CAMERA) is None


def test_distances_are_in_pixels() -> None:
    # One view of four that is off by 0.3 px, two freedoms each: its end and its middle alike.
    m2 = np.array([2.0 * (0.3 / SIGMA_PX) ** 2])
    np.testing.assert_allclose(off_px(m2, np.array([SIGMA_PX])), [0.3])
    assert CONFIRMED_PX > 0.3
