# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from edge.errors import ConfigError
from edge.geometry import se3, so3
from edge.outputs.frames import (
    BodyFrames,
    frd_from_level,
    quality_percent,
    require_level_metres,
)
from edge.outputs.motion import Velocity
from edge.types import MapPose, Mat4

LOOKS_AHEAD = se3.from_rotation_translation(
    np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), [0.0, 0.0, 0.0]
)
# A level camera in a z-up map that looks along the map's x axis.
R_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def _pose(T: Mat4, covariance: np.ndarray | None = None, smooth: Mat4 | None = None) -> MapPose:
    covariance = np.eye(6) * 1e-4 if covariance is None else covariance
    return MapPose(0, 5, T, T if smooth is None else smooth, covariance, 1.0, 3)


def _heading_camera(heading_rad: float, position: list[float]) -> Mat4:
    """A level camera that looks `heading_rad` to the left of the map's x axis."""
    return se3.from_rotation_translation(so3.exp([0.0, 0.0, heading_rad]) @ R_AHEAD, position)


def test_a_camera_along_x_is_a_level_body_without_yaw() -> None:
    frames = BodyFrames(LOOKS_AHEAD, frd_from_level(None))
    body = frames.convert(_pose(_heading_camera(0.0, [1.0, 2.0, 3.0])), None)
    np.testing.assert_allclose(body.T_world_body[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(body.T_world_body[:3, 3], [1.0, -2.0, -3.0])
    assert body.reset_counter == 3


def test_a_turn_to_the_left_is_negative_yaw() -> None:
    frames = BodyFrames(LOOKS_AHEAD, frd_from_level(None))
    body = frames.convert(_pose(_heading_camera(0.5, [0.0, 0.0, 0.0])), None)
    np.testing.assert_allclose(so3.log(body.T_world_body[:3, :3]), [0.0, 0.0, -0.5], atol=1e-12)


def test_with_the_map_facing_east_x_counts_east() -> None:
    frames = BodyFrames(LOOKS_AHEAD, frd_from_level(math.radians(90.0)))
    body = frames.convert(_pose(_heading_camera(0.0, [7.0, 0.0, 0.0])), None)
    np.testing.assert_allclose(body.T_world_body[:3, 3], [0.0, 7.0, 0.0], atol=1e-12)
    assert so3.log(body.T_world_body[:3, :3])[2] == pytest.approx(math.pi / 2)


def test_a_camera_ahead_of_the_body_puts_the_body_behind_it() -> None:
    T_body_cam = LOOKS_AHEAD.copy()
    T_body_cam[:3, 3] = 0.3, 0.0, -0.1  # 30 cm ahead, 10 cm above
    frames = BodyFrames(T_body_cam, frd_from_level(None))
    body = frames.convert(_pose(_heading_camera(0.0, [1.0, 0.0, 0.0])), None)
    np.testing.assert_allclose(body.T_world_body[:3, 3], [0.7, 0.0, 0.1], atol=1e-12)


def _random_scene(seed: int) -> tuple[np.random.Generator, Mat4, Mat4, Mat4]:
    rng = np.random.default_rng(seed)
    return rng, *(se3.exp(rng.normal(0.0, 1.0, 6)) for _ in range(3))


def test_covariance_is_that_of_perturbed_poses() -> None:
    rng, T_world_map, T_map_cam, T_body_cam = _random_scene(3)
    A = rng.normal(0.0, 1e-3, (6, 6))
    P = A @ A.T
    frames = BodyFrames(T_body_cam, T_world_map)
    body = frames.convert(_pose(T_map_cam, P), None)
    samples = []
    for xi in rng.multivariate_normal(np.zeros(6), P, 4000):
        T = T_map_cam.copy()
        T[:3, :3] = so3.exp(xi[3:]) @ T[:3, :3]
        T[:3, 3] += xi[:3]
        moved = frames.convert(_pose(T, P), None).T_world_body
        turn = so3.log(moved[:3, :3] @ body.T_world_body[:3, :3].T)
        samples.append(np.concatenate((moved[:3, 3] - body.T_world_body[:3, 3], turn)))
    # 4000 samples know a standard deviation to about 1 %, a covariance to 5 % of the largest.
    sampled = np.cov(np.array(samples).T)
    np.testing.assert_allclose(sampled, body.covariance, atol=0.05 * np.abs(body.covariance).max())


def test_a_smooth_pose_off_the_exact_one_is_less_certain_by_the_distance() -> None:
    exact = _heading_camera(0.0, [0.0, 0.0, 0.0])
    smooth = _heading_camera(0.0, [0.5, 0.0, 0.0])
    frames = BodyFrames(LOOKS_AHEAD, np.eye(4))
    body = frames.convert(_pose(exact, np.eye(6) * 1e-4, smooth), None)
    np.testing.assert_allclose(body.T_world_body[:3, 3], [0.5, 0.0, 0.0])
    assert body.covariance[0, 0] == pytest.approx(0.25 + 1e-4)


def test_velocity_is_that_of_the_body_as_finite_differences_see_it() -> None:
    _, T_world_map, T_map_cam, T_body_cam = _random_scene(5)
    linear, angular = np.array([0.3, -0.2, 0.5]), np.array([0.4, 0.1, -0.6])
    frames = BodyFrames(T_body_cam, T_world_map)
    step_s = 1e-6
    later = T_map_cam.copy()
    later[:3, :3] = so3.exp(angular * step_s) @ later[:3, :3]
    later[:3, 3] += linear * step_s
    body = frames.convert(_pose(T_map_cam), Velocity(linear, angular, np.eye(6)))
    T0, T1 = body.T_world_body, frames.convert(_pose(later), None).T_world_body
    R = T0[:3, :3]
    np.testing.assert_allclose(body.linear_m_s, R.T @ (T1 - T0)[:3, 3] / step_s, atol=1e-5)
    np.testing.assert_allclose(
        body.angular_rad_s, R.T @ so3.log(T1[:3, :3] @ R.T) / step_s, atol=1e-5
    )


def test_an_unknown_velocity_is_nan() -> None:
    body = BodyFrames(LOOKS_AHEAD, np.eye(4)).convert(_pose(np.eye(4)), None)
    assert np.all(np.isnan(body.linear_m_s))
    assert np.all(np.isnan(body.velocity_covariance))


def test_a_level_metric_map_passes() -> None:
    T = np.eye(4)
    T[2, 3] = 2.0
    passed = require_level_metres(metric=True, T_local_map=T.tolist(), map_name="hall.map")
    np.testing.assert_array_equal(passed, T)


@pytest.mark.parametrize(
    ("metric", "T_local_map", "remedy"),
    [
        (False, np.eye(4).tolist(), r"hall\.map: has no metric scale.*align hall\.map --points"),
        (True, None, r"hall\.map: is not level.*align hall\.map --up"),
    ],
)
def test_a_map_that_autopilots_cannot_fly_by_is_refused_with_its_remedy(
    metric: bool, T_local_map: list[list[float]] | None, remedy: str
) -> None:
    with pytest.raises(ConfigError, match=remedy):
        require_level_metres(metric=metric, T_local_map=T_local_map, map_name="hall.map")


@pytest.mark.parametrize(
    ("quality", "percent"), [(0.0, 0), (0.756, 76), (1.5, 100), (-1.0, 0), (math.nan, 0)]
)
def test_quality_becomes_percent(quality: float, percent: int) -> None:
    assert quality_percent(quality) == percent
