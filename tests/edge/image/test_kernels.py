# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.image import kernels
from edge.types import F32, U8


def random_grey(height: int, width: int) -> U8:
    return np.random.default_rng(height * width).integers(0, 256, (height, width), np.uint8)


def level_of(grey: np.ndarray) -> F32:
    level = np.full((*grey.shape, 3), np.nan, np.float32)
    level[..., 0] = grey
    kernels.differentiate(level)
    return level


@pytest.mark.parametrize("size", [(8, 12), (7, 9)], ids=["even", "odd"])
def test_halving_means_2x2_pixels_and_drops_odd_borders(size: tuple[int, int]) -> None:
    grey = random_grey(*size)
    h, w = size[0] // 2, size[1] // 2
    expected = grey[: 2 * h, : 2 * w].reshape(h, 2, w, 2).mean(axis=(1, 3))
    out, again = np.zeros((h, w, 3), np.float32), np.zeros((h, w, 3), np.float32)
    kernels.halve_grey(grey, out)
    assert np.array_equal(out[..., 0], expected)
    kernels.halve_level(level_of(grey), again)
    assert np.array_equal(again[..., 0], expected)


def test_copying_only_changes_the_type() -> None:
    grey, out = random_grey(5, 6), np.zeros((5, 6, 3), np.float32)
    kernels.copy_grey(grey, out)
    assert np.array_equal(out[..., 0], grey)


def test_gradients_are_central_differences_and_zero_at_borders() -> None:
    grey = random_grey(9, 11).astype(np.float32)
    level = level_of(grey)
    dy, dx = np.gradient(grey)
    inner = (slice(1, -1), slice(1, -1))
    assert np.array_equal(level[..., 1][inner], dx[inner])
    assert np.array_equal(level[..., 2][inner], dy[inner])
    border = np.ones(grey.shape, bool)
    border[inner] = False
    assert not np.any(level[border][:, 1:])


def test_undistort_reads_between_pixels() -> None:
    v, u = np.mgrid[:20, :30]
    image = (3 * u + 5 * v).astype(np.uint8)
    rng = np.random.default_rng(0)
    map_x = rng.uniform(0.0, 28.9, (15, 18)).astype(np.float32)
    map_y = rng.uniform(0.0, 18.9, (15, 18)).astype(np.float32)
    out = np.empty((15, 18), np.uint8)
    kernels.undistort(image, map_x, map_y, out)
    np.testing.assert_allclose(out, 3 * map_x + 5 * map_y, atol=0.51)


def test_undistort_gives_black_where_there_is_no_source() -> None:
    image, out = np.full((10, 10), 200, np.uint8), np.full((1, 6), 7, np.uint8)
    map_x = np.array([[-1.0, -0.1, 9.0, 5.0, 5.0, np.nan]], np.float32)
    map_y = np.array([[-1.0, 5.0, 5.0, 9.0, 5.0, 5.0]], np.float32)
    kernels.undistort(image, map_x, map_y, out)
    assert out.tolist() == [[0, 0, 0, 0, 200, 0]]


def test_a_halved_mask_needs_all_four() -> None:
    mask = np.ones((6, 7), np.uint8)
    mask[1, 0] = mask[2, 5] = mask[5, 3] = mask[0, 2] = 0
    out = np.empty((3, 3), np.uint8)
    kernels.halve_mask(mask, out)
    assert out.tolist() == [[0, 0, 1], [1, 1, 0], [1, 0, 1]]


@pytest.mark.parametrize("margin", [0, 1, 3])
def test_erosion_keeps_a_margin_from_holes_and_borders(margin: int) -> None:
    mask = np.ones((14, 17), np.uint8)
    mask[5, 9] = 0
    out = np.empty_like(mask)
    kernels.erode_mask(mask, margin, out)
    v, u = np.mgrid[:14, :17]
    inside = (u >= margin) & (v >= margin) & (u < 17 - margin) & (v < 14 - margin)
    clear = np.maximum(abs(u - 9), abs(v - 5)) > margin
    assert np.array_equal(out, inside & clear)
