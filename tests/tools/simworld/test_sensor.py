# SPDX-License-Identifier: Apache-2.0
"""Imperfections: each has a limit in which it does nothing, and does what it says."""

import numpy as np
import pytest

from tools.simworld.errors import WorldError
from tools.simworld.paths import Path, make_path
from tools.simworld.renderer import Renderer
from tools.simworld.sensor import Sensor, capture, gain


@pytest.fixture(scope="module")
def path(corner: Renderer) -> Path:
    return make_path(corner.world, 2, 3.0)


@pytest.fixture(scope="module")
def still(corner: Renderer) -> Path:
    return make_path(corner.world, 2, 3.0, kind="still")


def test_ideal_sensor_hands_on_the_rendered_view(corner: Renderer, path: Path) -> None:
    view, shot = corner.render(path.T_world_cam[9]), capture(corner, path, 9, Sensor())
    np.testing.assert_array_equal(shot.bgr, view.bgr)
    np.testing.assert_array_equal(shot.depth_m, view.depth_m)
    np.testing.assert_array_equal(shot.ids, view.ids)


@pytest.mark.parametrize("sensor", [Sensor(blur_ms=30.0), Sensor(rolling_ms=30.0)])
def test_blur_and_rolling_shutter_do_nothing_to_a_still_camera(
    corner: Renderer, still: Path, sensor: Sensor
) -> None:
    sharp = capture(corner, still, 3, Sensor()).bgr.astype(int)
    shot = capture(corner, still, 3, sensor).bgr.astype(int)
    assert np.abs(shot - sharp).max() <= 1  # rounding of the sum of light


def test_blur_takes_contrast_and_keeps_the_light(corner: Renderer, path: Path) -> None:
    sharp = capture(corner, path, 20, Sensor()).bgr.astype(float)
    blurred = capture(corner, path, 20, Sensor(blur_ms=60.0)).bgr.astype(float)
    edges = [np.square(np.diff(image, axis=1)).mean() for image in (sharp, blurred)]
    assert edges[1] < 0.9 * edges[0]
    assert ((blurred / 255) ** 2.2).mean() == pytest.approx(((sharp / 255) ** 2.2).mean(), rel=0.03)


def test_rolling_shutter_gives_each_row_the_pose_of_its_moment(
    corner: Renderer, path: Path
) -> None:
    shot = capture(corner, path, 9, Sensor(rolling_ms=40.0))
    t_s = path.t_ns[9] * 1e-9
    for row in (0, 30, 119):
        moment = t_s + 0.040 * (row - 59.5) / 119  # the stamp is that of the middle row
        exact = corner.render(path.at(np.array([moment]))[0])
        np.testing.assert_array_equal(shot.depth_m[row], exact.depth_m[row])
        apart = np.abs(shot.bgr[row].astype(int) - exact.bgr[row])
        assert np.mean(apart > 2) < 0.05  # edge pixels look at the next rows too


def test_gain_scales_light(corner: Renderer, path: Path) -> None:
    sensor = Sensor(exposure="sine", exposure_stops=0.5, seed=1)
    gains = [gain(sensor, t) for t in np.arange(0.0, 8.0, 0.05)]
    assert min(gains) == pytest.approx(2**-0.5, rel=0.01)
    assert max(gains) == pytest.approx(2**0.5, rel=0.01)
    plain = capture(corner, path, 9, Sensor()).bgr.astype(float)
    shot = capture(corner, path, 9, sensor).bgr.astype(float)
    middle = (plain > 40) & (plain < 180)
    expected = gain(sensor, path.t_ns[9] * 1e-9) ** (1 / 2.2)
    assert np.median(shot[middle] / plain[middle]) == pytest.approx(expected, rel=0.01)


def test_steps_of_exposure_hold_between_their_jumps() -> None:
    sensor = Sensor(exposure="steps", seed=3)
    gains = np.array([gain(sensor, t) for t in np.arange(0.0, 20.0, 0.05)])
    changes = np.abs(np.diff(gains)) > 1e-9
    assert 0 < changes.sum() < 0.1 * len(gains)
    assert np.log2(gains).max() <= 0.5


def test_vignette_darkens_the_corners_alone(corner: Renderer, path: Path) -> None:
    plain = capture(corner, path, 9, Sensor()).bgr.astype(float)
    shot = capture(corner, path, 9, Sensor(vignette=0.5)).bgr.astype(float)
    assert np.abs(shot - plain)[55:65, 75:85].max() <= 1.0
    assert shot[0, 0].mean() / plain[0, 0].mean() == pytest.approx(0.5 ** (1 / 2.2), abs=0.02)


def test_noise_has_its_deviation_and_its_frame_s_own_seed(corner: Renderer, still: Path) -> None:
    sharp = capture(corner, still, 3, Sensor()).bgr.astype(float)
    noisy = Sensor(noise_grey=3.0, seed=5)
    a, b, again = (capture(corner, still, i, noisy).bgr.astype(float) for i in (3, 4, 3))
    np.testing.assert_array_equal(a, again)
    assert (a != b).any()
    middle = (sharp > 100) & (sharp < 156)
    assert (a - sharp)[middle].std() == pytest.approx(3.0, rel=0.1)


@pytest.mark.parametrize(
    "wrong", [{"exposure": "wild"}, {"vignette": 1.5}, {"noise_grey": -1.0}, {"blur_samples": 0}]
)
def test_impossible_sensors_are_refused_in_one_line(wrong: dict[str, object]) -> None:
    with pytest.raises(WorldError) as error:
        Sensor(**wrong)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)
