# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry.camera import CameraModel
from edge.types import F32
from maps.depth.given import depth_at, depth_samples
from tests.maps import wall_drive
from tests.maps.wall_drive import CAMERA

POSE = wall_drive.poses(3)[0]


def wall_depth() -> F32:
    return wall_drive.depth(POSE).astype(np.float32)


def some_pixels(n: int = 200) -> F32:
    return np.random.default_rng(0).uniform((5, 5), (314, 234), (n, 2)).astype(np.float32)


def octaves(n: int, octave: int = 0) -> np.ndarray:
    return np.full(n, octave, np.uint8)


@pytest.mark.parametrize("octave", [0, 7])
def test_depths_of_a_wall_are_exact_within_their_deviation(octave: int) -> None:
    pixels = some_pixels()
    values, sigma = depth_at(wall_depth(), pixels, octaves(200, octave))
    u, v = pixels.T.astype(float)
    rays = np.stack(((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)))
    truth = (wall_drive.WALL_Z_M - POSE[2, 3]) / (POSE[2, :3] @ rays)
    assert (values > 0.0).all()
    assert (np.abs(values - truth) < sigma).all()
    assert sigma.max() < 0.03


def test_a_hole_a_step_or_the_border_gives_no_depth() -> None:
    depth = wall_depth()
    depth[100, 100] = 0.0
    depth[150:200, 20:60] = 0.0
    depth[:, 200:] *= 2.0
    pixels = np.array([[101, 101], [200, 50], [0, 5], [319, 239], [40, 170], [50, 50]], np.float32)
    values, sigma = depth_at(depth, pixels, octaves(6))
    assert (values > 0.0).tolist() == [False] * 5 + [True]
    assert (sigma > 0.0).tolist() == [False] * 5 + [True]


def test_a_slope_is_less_certain_than_a_front() -> None:
    flat = np.full((60, 60), 2.0, np.float32)
    slope = flat + np.arange(60, dtype=np.float32) * 0.01
    middle = np.array([[30, 30]], np.float32)
    sigma = [depth_at(depth, middle, octaves(1))[1][0] for depth in (flat, slope)]
    assert sigma[1] > 1.5 * sigma[0]


def test_samples_lie_on_gradients_all_over_the_image() -> None:
    image = wall_drive.picture(wall_drive.wall(), POSE)
    samples = depth_samples(image, wall_depth(), CAMERA, 200)
    assert 150 <= len(samples.pixels) <= 200
    assert len({tuple(cell) for cell in (samples.pixels // 80).astype(int)}) == 12
    u, v = samples.pixels.astype(int).T
    step = np.abs(np.gradient(image.astype(float))).sum(axis=0)
    assert np.median(step[v, u]) > 3.0 * np.median(step)
    truth = 1.0 / wall_depth()[v, u]
    assert np.abs(samples.inverse_depth - truth).max() < samples.sigma.min()


def test_samples_are_in_ideal_pixels_and_only_where_depth_is_known() -> None:
    lens = CameraModel(320, 240, 260.0, 262.0, 161.0, 118.5, "radtan", (-0.2, 0.05, 0.0, 0.0))
    image, depth = wall_drive.picture(wall_drive.wall(), POSE), wall_depth()
    depth[:, :160] = 0.0
    samples = depth_samples(image, depth, lens, 200)
    raw = lens.distort_pixels(samples.pixels.astype(np.float64))
    assert raw[:, 0].min() > 160.0
    assert np.abs(raw - np.round(raw)).max() < 1e-3


def test_no_samples_where_none_are_wanted_or_known() -> None:
    image = wall_drive.picture(wall_drive.wall(), POSE)
    assert len(depth_samples(image, wall_depth(), CAMERA, 0).pixels) == 0
    assert len(depth_samples(image, np.zeros_like(wall_depth()), CAMERA, 100).pixels) == 0
