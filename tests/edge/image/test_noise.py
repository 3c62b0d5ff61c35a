# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from edge.geometry.camera import CameraModel
from edge.image.noise import BEARABLE_GREY, UNBEARABLE_GREY, NoiseMeter, smoothing
from edge.image.pyramid import PyramidBuilder
from edge.runtime.synthetic import WallDrive
from edge.types import F64, U8

CAMERA = CameraModel(640, 480, 560.0, 560.0, 319.5, 239.5)


def noisy(image: U8, sigma: float, seed: int = 0) -> U8:
    noise: F64 = np.random.default_rng(seed).normal(0.0, sigma, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma", [2.0, 4.0, 8.0, 16.0])
def test_noise_is_measured_in_spite_of_texture(sigma: float) -> None:
    image = noisy(WallDrive(1).image(0), sigma)
    assert NoiseMeter().sigma_grey(image) == pytest.approx(sigma, rel=0.2)


def test_edges_and_shades_are_no_noise() -> None:
    image = np.tile(np.linspace(20, 220, 640).astype(np.uint8), (480, 1))
    cv2.rectangle(image, (100, 100), (300, 250), 255, -1)
    cv2.putText(image, "mapvo", (320, 300), cv2.FONT_HERSHEY_SIMPLEX, 3.0, 0, 5)
    assert NoiseMeter().sigma_grey(image) < 0.5


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_blank_images_have_no_noise(grey: int) -> None:
    assert NoiseMeter().sigma_grey(np.full((480, 640), grey, np.uint8)) == 0.0


def test_ends_of_the_scale_hide_no_noise() -> None:
    image = np.full((480, 640), 128, np.uint8)
    image[:, :400] = 0
    rough = noisy(image, 8.0)
    rough[:, :400] = 0
    assert NoiseMeter().sigma_grey(rough) == pytest.approx(8.0, rel=0.2)


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (3, 3), (8, 8)])
def test_tiny_images_are_measured_too(size: tuple[int, int]) -> None:
    assert NoiseMeter().sigma_grey(noisy(np.full(size, 128, np.uint8), 5.0)) >= 0.0


def test_smoothing_sets_in_gradually() -> None:
    assert smoothing(0.0) == smoothing(BEARABLE_GREY) == 0.0
    assert smoothing(UNBEARABLE_GREY) == smoothing(100.0) == 1.0
    assert 0.0 < smoothing(0.5 * (BEARABLE_GREY + UNBEARABLE_GREY)) < 1.0


@pytest.mark.parametrize("halvings", [0, 1])
def test_pyramids_of_noisy_images_are_smoothed(halvings: int) -> None:
    flat = np.full((480, 640), 128, np.uint8)
    builder = PyramidBuilder(CAMERA, halvings, 2, 2)
    grey = builder.build(noisy(flat, 20.0)).levels[0][1:-1, 1:-1, 0]
    # A 3x3 binomial mean leaves (6/16)^2 of white noise's variance.
    assert np.std(grey) == pytest.approx(20.0 / 2**halvings * 6 / 16, rel=0.05)
    assert np.mean(grey) == pytest.approx(128.0, abs=0.5)


def test_pyramids_of_clean_images_are_not() -> None:
    image = noisy(WallDrive(1).image(0), 1.0)
    level = PyramidBuilder(CAMERA, 0, 2, 2).build(image).levels[0]
    assert np.array_equal(level[..., 0], image)


def test_smoothing_moves_no_edge() -> None:
    image = np.full((480, 640), 60, np.uint8)
    image[:, 320:] = 180
    rough, clean = noisy(image, 20.0), noisy(image, 0.0)
    builder = PyramidBuilder(CAMERA, 0, 1, 2)
    mean = builder.build(rough).levels[0][1:-1, :, 0].mean(axis=0)
    crossing = 319 + (120.0 - mean[319]) / (mean[320] - mean[319])
    assert crossing == pytest.approx(319.5, abs=0.1)
    assert np.array_equal(builder.build(clean).levels[0][..., 0], clean)
