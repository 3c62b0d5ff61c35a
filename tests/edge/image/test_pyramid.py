# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from edge.geometry.camera import CameraModel
from edge.image.pyramid import MASK_MARGIN_PX, STILL, PyramidBuilder, half_size
from edge.types import F64, U8, Pinhole

# The ray to each pixel decides its grey: flat fields of rays are ramps in every true pyramid.
GREY_PER_X, GREY_PER_Y = 60.0, 45.0


def ideal_ramp(camera: Pinhole) -> F64:
    """Grey (h, w) of the world's ramp at an ideal camera's pixel centres."""
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return 128.0 + GREY_PER_X * x + GREY_PER_Y * y


def raw_ramp(camera: CameraModel) -> U8:
    """The same world as the lens shows it."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    ideal = camera.undistort(camera.normalise(np.column_stack((u.ravel(), v.ravel()))))
    grey = 128.0 + ideal @ [GREY_PER_X, GREY_PER_Y]
    return np.clip(np.nan_to_num(np.rint(grey)), 0, 255).astype(np.uint8).reshape(u.shape)


CAMERAS = {
    "even": CameraModel(320, 256, 240.0, 242.0, 161.5, 124.5),
    "odd": CameraModel(331, 263, 240.0, 242.0, 161.5, 124.5),
    "barrel": CameraModel(320, 256, 220.0, 222.0, 161.5, 124.5, "radtan", (-0.2, 0.03, 1e-3, 0)),
    "cushion": CameraModel(320, 256, 220.0, 222.0, 161.5, 124.5, "radtan", (0.25, 0.0, 0.0, 0.0)),
    "equidistant": CameraModel(
        321, 257, 180.0, 182.0, 161.5, 124.5, "equidistant", (-0.02, 0.01, 0.0, 0.0)
    ),
}


def build(
    camera: CameraModel, halvings: int, n_levels: int = 3, n_buffers: int = 2
) -> PyramidBuilder:
    return PyramidBuilder(camera, halvings, n_levels, n_buffers)


@pytest.mark.parametrize("halvings", [0, 1, 2])
@pytest.mark.parametrize("name", CAMERAS)
def test_a_ramp_stays_the_same_ramp_at_every_level(name: str, halvings: int) -> None:
    camera = CAMERAS[name]
    builder = build(camera, halvings)
    pyramid = builder.build(raw_ramp(camera))
    assert len(pyramid.levels) == len(builder.pinholes) == len(builder.masks) == 3
    for level, pinhole, mask in zip(pyramid.levels, builder.pinholes, builder.masks, strict=True):
        assert level.shape == (pinhole.height, pinhole.width, 3)
        assert mask.shape == level.shape[:2]
        valid = mask > 0
        assert np.count_nonzero(valid) > 0.1 * mask.size
        error = (level[..., 0] - ideal_ramp(pinhole))[valid]
        # Half a grey of rounding in the raw image, as much again after undistortion;
        # a shift by half a pixel of the finest level would already show in the mean.
        assert np.abs(error).max() < 1.3
        assert abs(error.mean()) < 0.06
        slope = level[valid][:, 1:].mean(axis=0)
        expected = (GREY_PER_X / pinhole.fx, GREY_PER_Y / pinhole.fy)
        np.testing.assert_allclose(slope, expected, rtol=0.02)


@pytest.mark.parametrize("halvings", [0, 1, 2])
def test_level_sizes_and_scale(halvings: int) -> None:
    builder = build(CAMERAS["odd"], halvings)
    for k, pinhole in enumerate(builder.pinholes):
        factor = 2 ** (halvings + k)
        assert (pinhole.width, pinhole.height) == (331 // factor, 263 // factor)
        assert pinhole.fx == pytest.approx(240.0 / factor)
        # Pixel centres on integers: the image's corner at -0.5 stays.
        assert (pinhole.cx + 0.5) * factor == pytest.approx(161.5 + 0.5)
        assert (pinhole.cy + 0.5) * factor == pytest.approx(124.5 + 0.5)
    assert builder.scale == 2**halvings


def test_halving_intrinsics_twice_is_quartering() -> None:
    once = half_size(half_size(Pinhole(640, 480, 500.0, 501.0, 320.25, 239.0)))
    assert (once.width, once.height) == (160, 120)
    np.testing.assert_allclose(once[2:], [125.0, 125.25, 79.6875, 59.375])


@pytest.mark.parametrize("name", CAMERAS)
def test_masks_keep_their_margin_from_what_the_lens_does_not_show(name: str) -> None:
    camera = CAMERAS[name]
    builder = build(camera, 1, n_levels=4)
    # White everywhere: what is not shown is black, and so is anything interpolated from it.
    pyramid = builder.build(np.full((camera.height, camera.width), 255, np.uint8))
    for level, mask in zip(pyramid.levels, builder.masks, strict=True):
        m = MASK_MARGIN_PX
        assert not mask[:m].any()
        assert not mask[-m:].any()
        assert not mask[:, :m].any()
        assert not mask[:, -m:].any()
        for v, u in np.argwhere(mask)[::7]:
            patch = level[v - m : v + m + 1, u - m : u + m + 1]
            assert np.all(patch[..., 0] == 255.0)
        whole = (mask.shape[0] - 2 * m) * (mask.shape[1] - 2 * m)
        assert (np.count_nonzero(mask) < whole) == (name == "cushion")


def test_a_pyramid_lives_until_its_buffer_comes_round() -> None:
    camera = CAMERAS["even"]
    builder = build(camera, 1, n_buffers=3)
    white, black = np.full((256, 320), 255, np.uint8), np.zeros((256, 320), np.uint8)
    first = builder.build(white)
    for _ in range(2):
        builder.build(black)
        assert first.levels[0][30, 30, 0] == 255.0
    builder.build(black)
    assert first.levels[0][30, 30, 0] == 0.0


def test_a_kept_pyramid_lives_until_another_is_kept() -> None:
    builder = build(CAMERAS["even"], 1, n_buffers=3)
    greys = [np.full((256, 320), 10 * n, np.uint8) for n in range(12)]
    first = builder.build(greys[1])
    builder.keep()
    for n in range(2, 9):
        last = builder.build(greys[n])
        assert first.levels[0][30, 30, 0] == 10.0
        assert last.levels[0][30, 30, 0] == 10.0 * n
    builder.keep()
    for n in (9, 10):
        builder.build(greys[n])
    assert last.levels[0][30, 30, 0] == 80.0
    assert first.levels[0][30, 30, 0] != 10.0


def test_builders_know_which_images_they_would_make_alike() -> None:
    camera, turning = CAMERAS["barrel"], np.array([0.1, 0.0, 0.3])
    one, other = build(camera, 1), build(camera, 1)
    still = one.build(raw_ramp(camera))
    assert other.is_like(still, turning)
    assert np.array_equal(other.build(raw_ramp(camera), turning).levels[0], still.levels[0])
    for lens in ((0.01, 0.0, 0.0), (0.0, 0.0, 0.3)):
        other.use(other.undistortion(*lens))
        assert not other.is_like(still, STILL)
    for builder in (one, other):
        builder.use(builder.undistortion(0.0, 0.02, 0.0))
    turned = one.build(raw_ramp(camera), turning)
    assert other.is_like(turned, turning)
    assert not other.is_like(turned, STILL)
    other.use(replace(other.used, even_light=True))
    assert not other.is_like(turned, turning)


def test_the_raw_image_is_not_touched() -> None:
    camera = CAMERAS["barrel"]
    raw = raw_ramp(camera)
    raw.flags.writeable = False
    copy = raw.copy()
    build(camera, 2).build(raw)
    assert np.array_equal(raw, copy)
