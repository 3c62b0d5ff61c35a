# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from edge.geometry.camera import CameraModel
from edge.image.pyramid import PyramidBuilder
from edge.odometry import kernels_window as kw
from edge.odometry.lens import (
    HIGHEST,
    SLOWEST_S,
    LensEstimate,
    LensSystem,
    as_calibrated,
    as_found,
    brightened,
    moved_pixels,
)
from edge.types import F64


def system(step: F64, sigma: F64) -> LensSystem:
    """Equations whose answer is `step` (5,), each known to `sigma` (5,)."""
    H = np.diag(np.power(sigma, -2.0))
    return LensSystem(H, -H @ step)


SIGMA = np.array([0.001, 0.001, 0.0005, 0.001, 0.01])


@pytest.mark.parametrize("response", [0.33, 0.6, 1.0])
def test_it_settles_at_the_truth_whatever_share_of_it_a_window_sees(response: float) -> None:
    estimate, truth = LensEstimate(), (-0.03, 0.025, 0.6)
    rng = np.random.default_rng(0)
    for _ in range(60):
        left = np.subtract(truth, (estimate.radial, estimate.readout_s, estimate.falloff))
        step = np.array([0.0, left[0], left[1], 0.0, left[2]])
        estimate.add(system(response * step + rng.normal(0.0, SIGMA), SIGMA))
    assert estimate.radial == pytest.approx(truth[0], abs=0.005 / response)
    assert estimate.readout_s == pytest.approx(truth[1], abs=0.005 / response)
    assert estimate.falloff == pytest.approx(truth[2], abs=0.1 / response)


def test_a_right_lens_is_left_alone() -> None:
    estimate = LensEstimate()
    rng = np.random.default_rng(1)
    assert not any(estimate.add(system(rng.normal(0.0, SIGMA), SIGMA)) for _ in range(200))
    assert (estimate.radial, estimate.readout_s) == (0.0, 0.0)


def test_a_shutter_may_be_slow_until_windows_have_told() -> None:
    estimate = LensEstimate()
    assert estimate.most_readout_s == SLOWEST_S
    for _ in range(20):
        estimate.add(system(np.zeros(5), SIGMA))
    assert estimate.most_readout_s < 0.01


def test_windows_that_contradict_each_other_change_nothing() -> None:
    estimate = LensEstimate()
    rng = np.random.default_rng(2)
    assert not any(
        estimate.add(system(0.004 + rng.normal(0.0, 20.0 * SIGMA), SIGMA)) for _ in range(100)
    )


def test_few_windows_change_nothing() -> None:
    estimate = LensEstimate()
    assert not any(estimate.add(system(np.full(5, 0.1), SIGMA)) for _ in range(3))


def test_no_answer_passes_the_limits() -> None:
    estimate = LensEstimate()
    for _ in range(100):
        estimate.add(system(np.full(5, 1.0), SIGMA))
    assert 0.0 < estimate.readout_s <= HIGHEST[2]
    assert 0.0 < estimate.radial <= HIGHEST[1]
    assert 0.0 < estimate.falloff <= HIGHEST[4]


def test_corners_are_never_taken_for_brighter_than_the_centre() -> None:
    estimate = LensEstimate()
    for _ in range(100):
        assert not estimate.add(system(np.array([0.0, 0.0, 0.0, 0.0, -0.5]), SIGMA))
    assert estimate.falloff == 0.0


@pytest.mark.parametrize("value", [0.0, -1e9, np.nan, np.inf])
def test_equations_without_sense_change_nothing(value: float) -> None:
    estimate = LensEstimate()
    for _ in range(20):
        assert not estimate.add(LensSystem(np.full((5, 5), value), np.full(5, value)))
    assert (estimate.radial, estimate.readout_s) == (0.0, 0.0)


def test_pixels_move_as_the_lens_bends() -> None:
    camera = CameraModel(640, 480, 500.0, 505.0, 321.0, 239.0)
    straight = np.array([[100.0, 300.0, 600.0, 321.0], [50.0, 200.0, 450.0, 239.0]], np.float32)
    moved = moved_pixels(straight, camera.pinhole, 0.01, np.zeros(3))
    bent = CameraModel(640, 480, 500.0, 505.0, 321.0, 239.0, "radtan", (0.01, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(moved.T, bent.undistort_pixels(straight.T), atol=0.02)


def test_pixels_move_as_the_camera_turns() -> None:
    camera = CameraModel(640, 480, 500.0, 505.0, 321.0, 239.0)
    straight = np.array([[100.0, 300.0, 600.0], [40.0, 240.0, 440.0]], np.float32)
    turn = np.array([0.002, -0.003, 0.004])
    moved = moved_pixels(straight, camera.pinhole, 0.0, turn)
    for n in range(3):
        ray = np.array([*camera.normalise(straight[:, n].astype(np.float64)[None])[0], 1.0])
        # The row saw with the camera turned on by its share.
        late = straight[1, n] / 480 - 0.5
        middle = ray + np.cross(late * turn, ray)
        expected = camera.denormalise(middle[None, :2] / middle[2])[0]
        np.testing.assert_allclose(moved[:, n], expected, atol=0.02)


def test_points_brighten_as_images_do() -> None:
    camera = CameraModel(240, 180, 200.0, 200.0, 119.5, 89.5)
    builder = PyramidBuilder(camera, 0, 1, 2)
    image = np.full((180, 240), 100, np.uint8)
    builder.use(builder.undistortion(0.0, 0.0, 0.7))
    level = builder.build(image).levels[0][..., 0]
    table = np.zeros((kw.POINT_ROWS, 3), np.float32)
    table[kw.U], table[kw.V] = [20.0, 119.0, 230.0], [10.0, 90.0, 150.0]
    table[kw.GREY : kw.GREY + kw.PATTERN_SIZE] = 100.0
    brighter = brightened(table, camera.pinhole, 0.7, (None, None))
    grey = brighter[kw.GREY]
    np.testing.assert_allclose(grey, level[[10, 90, 150], [20, 119, 230]], rtol=1e-4)
    assert grey[0] > 150.0
    builder.use(replace(builder.used, even_light=True))
    evened = builder.build(image)
    even = brightened(brighter, camera.pinhole, 0.0, (None, evened.gain))
    level = evened.levels[0][..., 0]
    np.testing.assert_allclose(even[kw.GREY], level[[10, 90, 150], [20, 119, 230]], rtol=1e-4)
    as_before = brightened(even, camera.pinhole, 0.0, (evened.gain, None))
    np.testing.assert_allclose(as_before[kw.GREY], grey, rtol=1e-5)


def test_depths_leave_in_the_pixels_of_the_calibration() -> None:
    camera = CameraModel(640, 480, 525.0, 525.0, 320.0, 240.0)
    bent = CameraModel(640, 480, 525.0, 525.0, 320.0, 240.0, "radtan", (0.02, 0.0, 0.0, 0.0))
    calibrated = np.array([[12.0, 300.0, 600.0], [11.0, 200.0, 450.0]], np.float32)
    found = as_found(calibrated, camera.pinhole, 0.02)
    np.testing.assert_allclose(found.T, bent.undistort_pixels(calibrated.T), atol=0.3)
    assert np.abs(found - calibrated).max() > 3.0
    back = as_calibrated(found, camera.pinhole, 0.02)
    np.testing.assert_allclose(back, calibrated, atol=0.5)
