# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from edge.geometry.camera import CameraModel
from edge.image.border import eroded, exposed
from edge.image.pyramid import MASK_MARGIN_PX, PyramidBuilder
from edge.types import U8

HEIGHT, WIDTH = 240, 320


def scene(low: int = 40) -> U8:
    """An image of soft shades, none below `low`."""
    rng = np.random.default_rng(0)
    shades = rng.integers(low, 256, (HEIGHT, WIDTH), np.uint8)
    return np.asarray(cv2.GaussianBlur(shades, (0, 0), 2.0))


def circle(radius: float) -> U8:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.asarray(np.hypot(u - 160, v - 120) < radius, np.uint8)


@pytest.mark.parametrize("radius", [115.0, 150.0])
@pytest.mark.parametrize("black", [0, 9])
def test_a_circle_of_light_is_found(radius: float, black: int) -> None:
    inside = circle(radius)
    shown = exposed(np.where(inside > 0, scene(), np.uint8(black)))
    assert shown is not None
    # Corners of the opening are cut off by less than its width.
    assert np.count_nonzero(shown != inside) < 0.003 * inside.size
    assert np.all(shown >= inside)


def test_a_bar_along_one_side_is_found_however_dark_the_scene_is_elsewhere() -> None:
    image = scene()
    image[:, :12] = 0
    image[100:140, 150:200] = 0  # a black thing in the middle
    shown = exposed(image)
    assert shown is not None
    assert not shown[:, :12].any()
    assert shown[:, 12:].all()


def test_it_reads_floats_as_bytes() -> None:
    image = np.where(circle(110.0) > 0, scene(), np.uint8(5))
    from_bytes, from_floats = exposed(image), exposed(image.astype(np.float32))
    assert from_bytes is not None
    assert from_floats is not None
    assert np.array_equal(from_bytes, from_floats)


@pytest.mark.parametrize(
    "image",
    [
        scene(),
        np.zeros((HEIGHT, WIDTH), np.uint8),
        np.random.default_rng(1).integers(0, 10, (HEIGHT, WIDTH), np.uint8),
        np.random.default_rng(2).integers(0, 256, (HEIGHT, WIDTH), np.uint8),
    ],
    ids=["whole", "black", "dark", "noise"],
)
def test_no_frame_is_seen_where_there_is_none(image: U8) -> None:
    assert exposed(image) is None


def test_masks_leave_the_frame_out_and_take_it_in_again() -> None:
    camera = CameraModel(WIDTH, HEIGHT, 250.0, 250.0, 159.5, 119.5)
    builder = PyramidBuilder(camera, halvings=0, n_levels=2, n_buffers=1)
    held = builder.masks
    whole = [mask.copy() for mask in held]
    image = scene()
    image[:, :40] = 0
    builder.leave_out_frame(builder.build(image))
    first = 40 + MASK_MARGIN_PX
    assert not held[0][:, :first].any()
    assert np.array_equal(held[0][:, first:], whole[0][:, first:])
    assert not held[1][:, : 20 + MASK_MARGIN_PX].any()
    builder.use(builder.undistortion(0.0, 0.0, 0.1))
    assert not held[0][:, :first].any()
    builder.leave_out_frame(builder.build(scene()))
    for mask, before in zip(held, whole, strict=True):
        assert np.array_equal(mask, before)


@pytest.mark.parametrize("margin", [0, 1, 3])
def test_erosion_keeps_a_margin_from_holes_and_borders(margin: int) -> None:
    mask = np.ones((14, 17), np.uint8)
    mask[5, 9] = 0
    v, u = np.mgrid[:14, :17]
    inside = (u >= margin) & (v >= margin) & (u < 17 - margin) & (v < 14 - margin)
    clear = np.maximum(abs(u - 9), abs(v - 5)) > margin
    assert np.array_equal(eroded(mask, margin), inside & clear)
