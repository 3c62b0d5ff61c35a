# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.geometry import se3, so3
from edge.outputs.motion import MotionEstimator, Velocity
from edge.types import MapPose, Mat4, OdometryState, OdometryUpdate

PERIOD_NS = 33_333_333
SCALE = 2.5  # metres per odometry unit
T_MAP_ODOM = se3.exp([1.0, 2.0, 3.0, 0.4, -0.3, 0.8])


def _feed(
    estimator: MotionEstimator,
    path: list[Mat4],
    *,
    first: int = 0,
    odom_id: int = 1,
    scale: float = SCALE,
) -> Velocity | None:
    velocity = None
    for index, T_odom_cam in enumerate(path, start=first):
        t_ns = index * PERIOD_NS
        update = OdometryUpdate(index, t_ns, OdometryState.TRACKING, odom_id, T_odom_cam)
        T = T_MAP_ODOM @ T_odom_cam
        velocity = estimator.step(update, MapPose(index, t_ns, T, T, np.eye(6), scale, 0))
    return velocity


def _steady(count: int, linear: np.ndarray, angular: np.ndarray) -> list[Mat4]:
    seconds = np.arange(count) * PERIOD_NS * 1e-9
    return [se3.from_rotation_translation(so3.exp(angular * t), linear * t) for t in seconds]


def test_steady_motion_is_found_exactly_at_map_scale_and_in_map_axes() -> None:
    linear, angular = np.array([0.2, -0.1, 0.3]), np.array([0.3, 0.2, -0.1])
    velocity = _feed(MotionEstimator(), _steady(8, linear, angular))
    assert velocity is not None
    R = T_MAP_ODOM[:3, :3]
    np.testing.assert_allclose(velocity.linear_m_s, SCALE * R @ linear, atol=1e-9)
    np.testing.assert_allclose(velocity.angular_rad_s, R @ angular, atol=1e-6)


def test_the_covariance_covers_what_noise_does() -> None:
    rng = np.random.default_rng(4)
    linear = np.array([0.2, 0.0, 0.0])
    squares = []
    for _ in range(100):
        path = _steady(6, linear, np.zeros(3))
        for T in path:
            T[:3, 3] += rng.normal(0.0, 0.004, 3)
        velocity = _feed(MotionEstimator(), path)
        assert velocity is not None
        error = velocity.linear_m_s - SCALE * T_MAP_ODOM[:3, :3] @ linear
        squares.append(error @ np.linalg.solve(velocity.covariance[:3, :3], error))
    assert np.mean(squares) < 3.0  # of 3 degrees of freedom; the allowance for acceleration adds


def test_too_few_poses_or_an_unknown_scale_give_none() -> None:
    path = _steady(3, np.ones(3), np.zeros(3))
    assert _feed(MotionEstimator(), path) is None
    path = _steady(8, np.ones(3), np.zeros(3))
    assert _feed(MotionEstimator(), path, scale=float("nan")) is None


def test_another_odometry_frame_starts_anew() -> None:
    estimator = MotionEstimator()
    assert _feed(estimator, _steady(8, np.ones(3), np.zeros(3))) is not None
    jumped = _steady(3, np.ones(3), np.zeros(3))
    assert _feed(estimator, jumped, first=8, odom_id=2) is None


def test_a_lost_frame_starts_anew() -> None:
    estimator = MotionEstimator()
    _feed(estimator, _steady(8, np.ones(3), np.zeros(3)))
    assert estimator.step(OdometryUpdate(8, 8 * PERIOD_NS, OdometryState.LOST, 1), None) is None
    assert _feed(estimator, _steady(3, np.ones(3), np.zeros(3)), first=9) is None


def test_a_gap_forgets_what_was_before_it() -> None:
    estimator = MotionEstimator()
    _feed(estimator, _steady(8, np.ones(3), np.zeros(3)))
    later = _steady(3, np.ones(3), np.zeros(3))
    assert _feed(estimator, later, first=100) is None
