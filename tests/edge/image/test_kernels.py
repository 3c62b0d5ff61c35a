# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import so3
from edge.image import kernels
from edge.types import F32, F64, U8


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


STILL = np.zeros(3, np.float32)
UNIT = np.array([50.0, 50.0, 9.0, 7.0], np.float32)


def undistorted(image: U8, map_x: F32, map_y: F32, turn: F32 = STILL, k: F32 = UNIT) -> F32:
    maps = np.ascontiguousarray(np.stack((map_x, map_y), axis=2), np.float32)
    out = np.full((*map_x.shape, 3), 7.0, np.float32)
    scratch = np.full(image.size + 3 * map_x.shape[1], np.nan, np.float32)
    kernels.undistort(image, maps, turn, k, scratch, out)
    return out[..., 0]


def test_undistort_reads_between_pixels() -> None:
    v, u = np.mgrid[:20, :30]
    image = (3 * u + 5 * v).astype(np.uint8)
    rng = np.random.default_rng(0)
    map_x = rng.uniform(0.0, 28.9, (15, 18)).astype(np.float32)
    map_y = rng.uniform(0.0, 18.9, (15, 18)).astype(np.float32)
    grey = undistorted(image, map_x, map_y)
    np.testing.assert_allclose(grey, 3 * map_x + 5 * map_y, atol=1e-4)


def test_undistort_gives_black_where_there_is_no_source() -> None:
    image = np.full((10, 10), 200, np.uint8)
    map_x = np.array([[-1.0, -0.1, 9.0, np.nan, 5.0, 5.0]], np.float32)
    map_y = np.array([[-1.0, 5.0, 5.0, 5.0, 5.0, 9.0]], np.float32)
    assert undistorted(image, map_x, map_y).tolist() == [[0, 0, 0, 0, 200, 0]]


def test_rows_become_what_the_middle_one_would_have_seen() -> None:
    fx, fy, cx, cy = intrinsics = np.array([90.0, 95.0, 79.5, 59.5], np.float32)
    turn = np.array([0.03, -0.05, 0.08])
    v, u = np.mgrid[:120, :160].astype(np.float64)
    rays = np.stack(((u - cx) / fx, (v - cy) / fy, np.ones_like(u)), axis=-1)

    def grey(directions: F64) -> F64:
        x, y = directions[..., 0] / directions[..., 2], directions[..., 1] / directions[..., 2]
        return 120.0 + 60.0 * np.sin(9.0 * x + 4.0 * y) + 40.0 * np.cos(11.0 * y - 3.0 * x)

    # Each row is seen by a camera that has turned on by its share.
    turned = np.stack([rays[i] @ so3.exp((i / 120 - 0.5) * turn).T for i in range(120)])
    raw = np.rint(grey(turned)).astype(np.uint8)
    middle = (slice(10, -10), slice(10, -10))
    straight = undistorted(
        raw, u.astype(np.float32), v.astype(np.float32), turn.astype(np.float32), intrinsics
    )
    assert np.abs(straight - grey(rays))[middle].max() < 3.5
    assert np.abs(raw - grey(rays))[middle].max() > 20.0


def test_a_halved_mask_needs_all_four() -> None:
    mask = np.ones((6, 7), np.uint8)
    mask[1, 0] = mask[2, 5] = mask[5, 3] = mask[0, 2] = 0
    out = np.empty((3, 3), np.uint8)
    kernels.halve_mask(mask, out)
    assert out.tolist() == [[0, 0, 1], [1, 1, 0], [1, 0, 1]]
