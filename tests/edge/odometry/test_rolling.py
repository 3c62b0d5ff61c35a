# SPDX-License-Identifier: Apache-2.0
"""Fast turns under a rolling shutter must not look like translations."""

import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.image.pyramid import Pyramid, PyramidBuilder
from edge.odometry.last_motion import LastMotion
from edge.odometry.rolling import tracked_straight
from edge.odometry.tracker import Tracked, Tracker
from edge.types import Frame, Mat4
from tests.edge.odometry.drives import CORNER
from tests.edge.odometry.scenes import FRAME_NS, MIDDLE, rolling_image, to_bytes
from tests.edge.odometry.test_tracker import T_WORLD_REFERENCE, reference_of

READOUT_S = 0.025
FAST, SLOW = 1.5, 0.2  # [rad/s]


def rolling_frame(rate_rad_s: float, readout_s: float) -> tuple[Frame, Mat4]:
    """A frame taken while turning about the vertical axis, and T_world_cam at its middle row."""
    step = se3.exp([0, 0, 0, 0, rate_rad_s * FRAME_NS * 1e-9, 0])
    T_middle = T_WORLD_REFERENCE @ step
    image = rolling_image(CORNER, MIDDLE, T_middle, rate_rad_s, readout_s)
    return Frame(1, FRAME_NS, to_bytes(image, 1.0, seed=1)), T_middle


class Case:
    """A frame after a keyframe that the camera had not turned at yet."""

    def __init__(self, rate_rad_s: float, readout_s: float = READOUT_S) -> None:
        self.frame, self.T_true = rolling_frame(rate_rad_s, readout_s)
        self.builder = PyramidBuilder(MIDDLE, 0, 4, 3)
        self.builder.use(self.builder.undistortion(0.0, READOUT_S, 0.0))
        self.reference = reference_of(CORNER, self.builder)
        config = OdometryConfig().resolved()
        self.tracker = Tracker(self.builder.pinholes, self.builder.masks, config)
        self.last = LastMotion(T_WORLD_REFERENCE, np.eye(4), np.zeros(2), 3.0, t_ns=0)
        pyramid = self.builder.build(self.frame.image)
        guess = se3.inverse(self.T_true) @ T_WORLD_REFERENCE
        tracked = self.tracker.track(pyramid, self.reference, iter([guess]), np.zeros(2), 5.0)
        self.first = tracked, pyramid

    def again(self) -> tuple[Tracked, Pyramid]:
        return tracked_straight(
            self.frame, self.first, self.last, self.reference, self.tracker, self.builder
        )

    def off_m(self, tracked: Tracked) -> float:
        T = T_WORLD_REFERENCE @ se3.inverse(tracked.T_cam_reference)
        return float(np.linalg.norm(T[:3, 3] - self.T_true[:3, 3]))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_fast_turn_is_no_translation(sign: float) -> None:
    case = Case(sign * FAST)
    tracked, _ = case.first
    again, straight = case.again()
    assert case.off_m(tracked) > 0.03
    assert case.off_m(again) < 0.5 * case.off_m(tracked)
    np.testing.assert_allclose(straight.turning, [0, sign * FAST, 0], atol=0.4)


def test_a_slow_turn_is_tracked_once() -> None:
    case = Case(SLOW)
    assert case.again() == case.first


def test_without_the_frame_before_nothing_is_known_of_the_turn() -> None:
    case = Case(FAST)
    case.last.gap = 2
    assert case.again() == case.first
    case.last.gap, case.last.t_ns = 1, None
    assert case.again() == case.first


def test_what_is_worse_straight_stays_as_it_is() -> None:
    case = Case(FAST, readout_s=0.0)
    tracked, pyramid = case.first
    before = [level.copy() for level in pyramid.levels]
    again, kept = case.again()
    assert again is tracked
    assert not kept.turning.any()
    for level, old in zip(kept.levels, before, strict=True):
        np.testing.assert_array_equal(level, old)


def test_a_leap_is_no_motion() -> None:
    case = Case(SLOW)
    tracked, _ = case.first
    assert not case.last.leaps(tracked, case.reference)
    depth = 1.0 / case.reference.inverse_depth
    for share, leaps in ((0.15, False), (0.3, True)):
        case.last.T_cam_last = se3.exp([share * depth, 0, 0, 0, 0, 0])
        assert case.last.leaps(tracked, case.reference) is leaps
