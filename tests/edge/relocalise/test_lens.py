# SPDX-License-Identifier: Apache-2.0
"""Errors of the raw image as the ideal one shows them."""

import numpy as np
import pytest

from edge.config.relocalise import RelocaliseConfig
from edge.geometry import so3
from edge.geometry.camera import CameraModel
from edge.relocalise.features import Features
from edge.relocalise.lens import lens_shifts, magnification, read_at_once

CONFIG = RelocaliseConfig(lens_focal_share=0.0)
PLAIN = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5)
BARREL = CameraModel(
    752, 480, 458.0, 457.0, 367.0, 248.0, "radtan", (-0.283, 0.074, 0.0002, 0.00002)
)
FISHEYE = CameraModel(
    640, 400, 240.0, 240.0, 319.5, 199.5, "equidistant", (-0.01, 0.005, -0.003, 0.0)
)


def ideal_points(camera: CameraModel) -> np.ndarray:
    pixels = np.random.default_rng(0).uniform(
        (20, 20), (camera.width - 20, camera.height - 20), (200, 2)
    )
    return camera.normalise(pixels)


@pytest.mark.parametrize("camera", [PLAIN, BARREL, FISHEYE])
def test_noise_of_the_raw_image_spreads_in_the_ideal_one_as_the_magnification_says(camera) -> None:
    ideal = ideal_points(camera)
    raw = camera.distort_pixels(camera.denormalise(ideal))
    square = 0.05 * np.array(((1, 0), (0, 1), (-1, 0), (0, -1)))
    corners = np.array([camera.undistort_pixels(raw + step) for step in square])
    a, b = corners[0] - corners[2], corners[1] - corners[3]
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 0.01
    np.testing.assert_allclose(magnification(camera, ideal), np.sqrt(area), rtol=1e-3)


def test_a_lens_without_distortion_stretches_nothing() -> None:
    assert np.all(magnification(PLAIN, ideal_points(PLAIN)) == 1.0)


@pytest.mark.parametrize("camera", [PLAIN, BARREL, FISHEYE])
def test_a_bend_shifts_ideal_points_by_what_it_shifts_raw_ones(camera) -> None:
    ideal = ideal_points(camera)
    centre = np.zeros_like(ideal)
    shift = lens_shifts(camera, ideal, centre, CONFIG)[:, 1]
    raw = camera.distort(ideal)
    half = 0.5 * np.hypot(camera.width / camera.fx, camera.height / camera.fy)
    share = CONFIG.lens_corner_share * np.sum(raw**2, axis=1, keepdims=True) / half**2
    # A hundredth of it, so that it is a step of first order.
    bent = camera.denormalise(camera.undistort(raw * (1.0 + 0.01 * share)))
    expected = 100.0 * (bent - camera.denormalise(ideal))
    np.testing.assert_allclose(shift, expected, atol=0.02 * np.abs(expected).max())


def test_the_corner_of_any_lens_moves_by_the_same_share() -> None:
    for camera in (PLAIN, CameraModel(1226, 370, 707.0, 707.0, 600.0, 180.0)):
        corner = camera.normalise(
            np.array([[camera.cx + 0.5 * camera.width, camera.cy + 0.5 * camera.height]])
        )
        (shift,) = lens_shifts(camera, corner, np.zeros((1, 2)), CONFIG)[:, 1]
        half_px = 0.5 * np.hypot(camera.width, camera.height)
        assert np.hypot(*shift) == pytest.approx(CONFIG.lens_corner_share * half_px, rel=1e-6)


def test_what_both_images_bend_alike_shifts_nothing() -> None:
    ideal = ideal_points(FISHEYE)
    assert not lens_shifts(FISHEYE, ideal, ideal, CONFIG).any()


def test_where_the_lens_model_folds_back_all_stays_finite() -> None:
    far = np.array([[3.0, 2.0], [0.0, 0.0], [1.4, -1.2]])
    for camera in (BARREL, FISHEYE):
        assert np.isfinite(magnification(camera, far)).all()
        assert np.isfinite(lens_shifts(camera, far, np.zeros((3, 2)), CONFIG)).all()


@pytest.mark.parametrize("camera", [PLAIN, BARREL, FISHEYE])
def test_rows_read_in_a_turn_are_put_where_the_middle_row_saw_them(camera) -> None:
    rng = np.random.default_rng(1)
    turned = np.array([0.012, -0.02, 0.008])
    points = np.column_stack((ideal_points(camera), np.ones(200))) * rng.uniform(1, 4, (200, 1))
    middle = camera.denormalise(points[:, :2] / points[:, 2:])
    # The row on which a point is seen and when that is read hang together: a few rounds agree.
    late = np.zeros(200)
    for _ in range(8):
        seen = np.array(
            [so3.exp(-share * turned) @ p for share, p in zip(late, points, strict=True)]
        )
        raw = camera.project(seen)
        late = (raw[:, 1] + 0.5) / camera.height - 0.5
    ideal = camera.denormalise(seen[:, :2] / seen[:, 2:])
    features = Features(
        ideal.astype(np.float32),
        np.zeros((200, 32), np.uint8),
        np.zeros(200, np.uint8),
        np.zeros(200, np.float32),
        raw.astype(np.float32),
    )
    straight = read_at_once(features, turned, camera).pixels
    off = np.linalg.norm(straight - middle, axis=1)
    before = np.linalg.norm(ideal - middle, axis=1)
    assert before.max() > 2.0
    assert off.max() < 0.05 * before.max()


def test_a_camera_at_rest_reads_its_rows_at_once() -> None:
    pixels = PLAIN.denormalise(ideal_points(PLAIN)).astype(np.float32)
    features = Features(pixels, *(np.zeros(0),) * 3, pixels)
    np.testing.assert_array_equal(read_at_once(features, np.zeros(3), PLAIN).pixels, pixels)
