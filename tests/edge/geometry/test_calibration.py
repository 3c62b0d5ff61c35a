# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import calibration, se3
from edge.geometry.calibration import View, calibrate, parameters_of, refine_pose
from edge.geometry.camera import CameraModel
from edge.types import F64, Mat4

CAMERAS = {
    "none": CameraModel(640, 480, 500.0, 505.0, 322.0, 236.0),
    "radtan": CameraModel(
        *(640, 480, 500.0, 505.0, 322.0, 236.0), "radtan", (-0.28, 0.07, 0.001, -0.0005)
    ),
    "rational": CameraModel(
        *(640, 480, 500.0, 505.0, 322.0, 236.0),
        "radtan",
        (-0.1, 0.02, 0.001, -0.0005, 0.01, 0.1, 0.02, 0.01),
    ),
    "equidistant": CameraModel(
        *(640, 480, 300.0, 302.0, 322.0, 236.0), "equidistant", (0.02, -0.01, 0.004, -0.001)
    ),
}


def board() -> F64:
    """8 x 5 corners, 3 cm apart."""
    x, y = np.meshgrid(np.arange(1, 9), np.arange(1, 6))
    return np.stack((0.03 * x.ravel(), 0.03 * y.ravel(), np.zeros(40)), axis=1)


def poses(count: int = 14, seed: int = 0) -> list[Mat4]:
    """The board before the camera, here and there, tilted to all sides."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        tilt = se3.exp([0, 0, 0, *rng.uniform(-0.6, 0.6, 2), rng.uniform(-1.0, 1.0)])
        centre = np.eye(4)
        centre[:3, 3] = [-0.135, -0.09, 0.0]
        place = np.eye(4)
        z = rng.uniform(0.25, 0.45)
        place[:3, 3] = [*(rng.uniform(-0.25, 0.25, 2) * z), z]
        found.append(place @ tilt @ centre)
    return found


def views_of(
    camera: CameraModel, T: list[Mat4], noise_px: float = 0.0, seed: int = 0
) -> list[View]:
    rng = np.random.default_rng(seed)
    made = []
    for pose in T:
        pixels = camera.project(board() @ pose[:3, :3].T + pose[:3, 3])
        seen = np.all((pixels > 0) & (pixels < (camera.width, camera.height)), axis=1)
        pixels = pixels + rng.normal(0.0, noise_px, pixels.shape) if noise_px else pixels
        made.append(View(board()[seen], pixels[seen]))
    return made


def _nudged(camera: CameraModel, T: list[Mat4]) -> tuple[CameraModel, list[Mat4]]:
    rng = np.random.default_rng(3)
    values = parameters_of(camera)
    start = calibration.with_parameters(camera, np.r_[values[:4] * 1.05, 0.2 * values[4:]])
    assert start is not None
    return start, [se3.exp(rng.normal(0.0, 0.01, 6)) @ pose for pose in T]


@pytest.mark.parametrize("name", CAMERAS)
def test_the_exact_camera_comes_back_from_exact_views(name: str) -> None:
    camera, T = CAMERAS[name], poses()
    found = calibrate(*_arguments(camera, T))
    assert found.rms_px < 1e-4
    corners = np.array([[1.0, 1.0], [639, 1], [1, 479], [639, 479], [320, 240]])
    truth, ours = camera.undistort_pixels(corners), found.camera.undistort_pixels(corners)
    np.testing.assert_allclose(
        camera.normalise(truth), found.camera.normalise(ours), rtol=1e-4, atol=1e-5
    )
    if name != "rational":  # whose coefficients can hardly be told apart
        np.testing.assert_allclose(parameters_of(found.camera), parameters_of(camera), atol=1e-3)


def _arguments(
    camera: CameraModel, T: list[Mat4], noise_px: float = 0.0, seed: int = 0
) -> tuple[CameraModel, list[View], list[Mat4]]:
    start, from_here = _nudged(camera, T)
    return start, views_of(camera, T, noise_px, seed), from_here


def test_errors_are_as_large_as_it_says() -> None:
    camera, T = CAMERAS["radtan"], poses()
    errors = []
    for seed in range(6):
        found = calibrate(*_arguments(camera, T, noise_px=0.2, seed=seed))
        assert found.rms_px == pytest.approx(0.2, rel=0.1)
        errors.append((parameters_of(found.camera) - parameters_of(camera)) / found.sigma)
    # 48 normal numbers, but for their correlations.
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.5


def test_a_few_wrong_corners_do_little_harm() -> None:
    camera, T = CAMERAS["radtan"], poses()
    start, views, from_here = _arguments(camera, T, noise_px=0.1)
    for view in views[::3]:
        view.pixels[[0, 7]] += (14.0, -9.0)
    found = calibrate(start, views, from_here)
    assert found.camera.fx == pytest.approx(camera.fx, rel=0.004)
    assert found.camera.cx == pytest.approx(camera.cx, abs=4.0)  # squares alone: 24 px


def test_a_pose_is_refined_by_a_camera_that_is_held() -> None:
    camera, T = CAMERAS["equidistant"], poses(3)
    for view, pose in zip(views_of(camera, T), T, strict=True):
        refined = refine_pose(camera, view, se3.exp([0.01, -0.01, 0.02, 0.03, 0.02, -0.01]) @ pose)
        np.testing.assert_allclose(refined, pose, atol=1e-8)


@pytest.mark.parametrize("name", CAMERAS)
def test_slopes_are_those_of_the_projection(name: str) -> None:
    camera, pose = CAMERAS[name], poses(1)[0]
    (view,) = views_of(camera, [pose])
    _, J_camera, J_pose = calibration._residual_and_jacobians(
        camera, view.pixels, calibration._move(pose, view.points)
    )
    h = 1e-6
    for j in range(6):
        xi = np.zeros(6)
        xi[j] = h
        ahead = calibration.residual_px(camera, view, se3.exp(xi) @ pose)
        behind = calibration.residual_px(camera, view, se3.exp(-xi) @ pose)
        np.testing.assert_allclose(J_pose[:, :, j], (behind - ahead) / (2 * h), atol=1e-3)
    values = parameters_of(camera)
    for j in range(len(values)):
        step = np.zeros(len(values))
        step[j] = h * max(1.0, abs(values[j]))
        moved = [calibration.with_parameters(camera, values + s * step) for s in (1, -1)]
        assert moved[0] is not None
        assert moved[1] is not None
        ahead, behind = (calibration.residual_px(one, view, pose) for one in moved if one)
        np.testing.assert_allclose(
            J_camera[:, :, j], (behind - ahead) / (2 * step[j]), atol=2e-3, rtol=1e-4
        )
