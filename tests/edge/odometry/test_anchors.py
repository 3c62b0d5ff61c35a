# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.odometry import anchors


def added(idepth: float, target: float, sigma: float) -> tuple[float, float, float]:
    """Energy, curvature and slope of one anchor."""
    Hd, bd = np.zeros(1, np.float32), np.zeros(1, np.float32)
    information = anchors.information_of(np.array([sigma], np.float32))
    anchor = np.stack((np.array([target], np.float32), information))
    energy = anchors.add(anchor, np.array([idepth], np.float32), Hd, bd)
    return energy, float(Hd[0]), float(bd[0])


@pytest.mark.parametrize("off", [-0.08, -0.01, 0.015, 0.1])
def test_the_slope_is_half_of_the_energys(off: float) -> None:
    step = 1e-3
    higher, lower = (added(0.5 + off + s, 0.5, 0.02)[0] for s in (step, -step))
    assert 2.0 * added(0.5 + off, 0.5, 0.02)[2] == pytest.approx(
        (higher - lower) / (2 * step), rel=0.02
    )


def test_far_from_the_map_it_pulls_no_harder() -> None:
    near, far, farther = (abs(added(0.5 + off, 0.5, 0.02)[2]) for off in (0.02, 0.08, 0.3))
    assert near < far
    assert farther == pytest.approx(far, rel=1e-3)


def test_points_without_anchor_are_left_alone() -> None:
    Hd, bd = np.ones(3, np.float32), np.ones(3, np.float32)
    anchor = np.zeros((2, 3), np.float32)
    assert anchors.add(anchor, np.full(3, 0.7, np.float32), Hd, bd) == 0.0
    assert np.all(Hd == 1.0)
    assert np.all(bd == 1.0)
