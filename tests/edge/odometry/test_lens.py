# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry.camera import CameraModel
from edge.odometry.lens import LIMIT, LensEstimate, LensSystem, moved_pixels
from edge.types import F64


def system(step: F64, sigma: F64) -> LensSystem:
    """Equations whose answer is `step` (4,), each known to `sigma` (4,)."""
    H = np.diag(np.power(sigma, -2.0))
    return LensSystem(H, -H @ step)


SIGMA = np.array([0.001, 0.001, 0.0005, 0.001])


@pytest.mark.parametrize("response", [0.33, 0.6, 1.0])
def test_it_settles_at_the_truth_whatever_share_of_it_a_window_sees(response: float) -> None:
    estimate, truth = LensEstimate(), (-0.03, 0.025)
    rng = np.random.default_rng(0)
    for _ in range(60):
        left = np.array([0.0, truth[0] - estimate.radial, truth[1] - estimate.readout_s, 0.0])
        estimate.add(system(response * left + rng.normal(0.0, 0.001, 4), SIGMA))
    assert estimate.radial == pytest.approx(truth[0], abs=0.005 / response)
    assert estimate.readout_s == pytest.approx(truth[1], abs=0.005 / response)


def test_a_right_lens_is_left_alone() -> None:
    estimate = LensEstimate()
    rng = np.random.default_rng(1)
    assert not any(estimate.add(system(rng.normal(0.0, 0.001, 4), SIGMA)) for _ in range(200))
    assert (estimate.radial, estimate.readout_s) == (0.0, 0.0)


def test_windows_that_contradict_each_other_change_nothing() -> None:
    estimate = LensEstimate()
    rng = np.random.default_rng(2)
    assert not any(
        estimate.add(system(0.004 + rng.normal(0.0, 0.02, 4), SIGMA)) for _ in range(100)
    )


def test_few_windows_change_nothing() -> None:
    estimate = LensEstimate()
    assert not any(estimate.add(system(np.full(4, 0.01), SIGMA)) for _ in range(3))


def test_no_answer_passes_the_limits() -> None:
    estimate = LensEstimate()
    for _ in range(100):
        estimate.add(system(np.full(4, 0.1), SIGMA))
    assert 0.0 < estimate.readout_s <= LIMIT[2]
    assert 0.0 < estimate.radial <= LIMIT[1]


@pytest.mark.parametrize("value", [0.0, -1e9, np.nan, np.inf])
def test_equations_without_sense_change_nothing(value: float) -> None:
    estimate = LensEstimate()
    for _ in range(20):
        assert not estimate.add(LensSystem(np.full((4, 4), value), np.full(4, value)))
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
