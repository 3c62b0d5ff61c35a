# SPDX-License-Identifier: Apache-2.0
"""What evening an image takes away, and what it leaves."""

from dataclasses import replace

import numpy as np
import pytest

from edge.geometry.camera import CameraModel
from edge.image.pyramid import PyramidBuilder
from edge.image.shade import gain_against_shade, gain_by_cells, sampled_gain
from edge.types import F32, F64, U8

CAMERA = CameraModel(320, 240, 250.0, 250.0, 159.5, 119.5)
ALL: U8 = np.ones((240, 320), np.uint8)


def texture(seed: int = 0) -> F32:
    rng = np.random.default_rng(seed)
    return np.asarray(100.0 + rng.normal(0.0, 25.0, ALL.shape), np.float32)


def spot(u: float, v: float) -> F64:
    y, x = np.mgrid[:240, :320]
    near = np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2.0 * 90.0**2))
    return np.asarray(0.4 + 1.2 * near)


def test_an_even_image_stays_as_it_is() -> None:
    gain = gain_against_shade(np.full(ALL.shape, 90.0, np.float32), ALL)
    assert gain is not None
    np.testing.assert_allclose(gain, 1.0, atol=1e-5)


def test_the_same_texture_under_two_lamps_looks_alike() -> None:
    evened, apart = [], []
    for u, v in ((80.0, 60.0), (250.0, 170.0)):
        image = (texture() * spot(u, v)).astype(np.float32)
        gain = gain_against_shade(image, ALL)
        assert gain is not None
        apart.append(image - image.mean())
        evened.append(image * gain - (image * gain).mean())
    between = float(np.std(apart[0] - apart[1]))
    assert float(np.std(evened[0] - evened[1])) < 0.35 * between


@pytest.mark.parametrize("shape", [(240, 320), (236, 325), (7, 5)])
def test_gains_by_cells_are_those_of_all_pixels(shape: tuple[int, int]) -> None:
    image = np.resize(texture() * spot(80.0, 60.0), shape).astype(np.float32)
    mask: U8 = np.ones(shape, np.uint8)
    whole, cells = gain_against_shade(image, mask), gain_by_cells(image, mask)
    assert whole is not None
    assert cells is not None
    assert whole.shape == shape
    v, u = (at.ravel().astype(np.float32) for at in np.mgrid[: shape[0], : shape[1]])
    np.testing.assert_allclose(sampled_gain(cells, u, v), whole.ravel(), rtol=1e-3)


def test_what_shows_nothing_does_not_count() -> None:
    image, mask = texture(), ALL.copy()
    mask[:, 200:] = 0
    dark = np.where(mask > 0, image, 0.0).astype(np.float32)
    bright = np.where(mask > 0, image, 255.0).astype(np.float32)
    gains = [gain_against_shade(some, mask) for some in (dark, bright)]
    assert gains[0] is not None
    np.testing.assert_array_equal(gains[0], gains[1])
    assert gain_against_shade(image, np.zeros_like(mask)) is None


def test_an_evened_pyramid_still_tells_what_the_camera_saw() -> None:
    image = np.clip(texture() * spot(80.0, 60.0), 0.0, 255.0).astype(np.uint8)
    plain, even = (PyramidBuilder(CAMERA, 0, 3, 1) for _ in range(2))
    even.use(replace(even.used, even_light=True))
    as_it_is, evened = plain.build(image), even.build(image)
    np.testing.assert_allclose(evened.as_seen, as_it_is.levels[0][..., 0], atol=0.5)
    assert abs(evened.contrast_grey - as_it_is.contrast_grey) < 0.1 * as_it_is.contrast_grey
    assert abs(evened.levels[-1][..., 0].std() - as_it_is.contrast_grey) > 5.0


def test_a_covered_lens_gains_no_contrast() -> None:
    rng = np.random.default_rng(1)
    covered = np.clip(rng.normal(6.0, 2.0, ALL.shape), 0, 255).astype(np.uint8)
    builder = PyramidBuilder(CAMERA, 0, 4, 1)
    builder.use(replace(builder.used, even_light=True))
    assert builder.build(covered).contrast_grey < 1.0
