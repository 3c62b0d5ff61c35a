# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.odometry import kernels_select as ks
from edge.types import F32, I32
from tests.edge.odometry.built_window import margin_mask
from tests.edge.odometry.scenes import MIDDLE, Corner, level_of

SIZE = (MIDDLE.height, MIDDLE.width)


def slope_level(slope: F32) -> F32:
    """Level whose gradient is `slope` (h, w) along x."""
    level = np.zeros((*slope.shape, 3), np.float32)
    level[..., 1] = slope
    return level


def thresholds_of(level: F32, quantile: float = 0.5, margin: float = 7.0) -> F32:
    out = np.empty((-(-SIZE[0] // ks.REGION_PX), -(-SIZE[1] // ks.REGION_PX)), np.float32)
    ks.region_thresholds(level, margin_mask(), quantile, margin, out)
    return out


def picked(level: F32, thresholds: F32, spacing: int, capacity: int = 20_000) -> I32:
    out = np.zeros((3, capacity), np.int32)
    return out[:, : ks.pick(level, margin_mask(), thresholds, spacing, out)]


def test_thresholds_are_the_regions_median_plus_a_margin() -> None:
    level = slope_level(np.full(SIZE, 10.4, np.float32))
    np.testing.assert_allclose(thresholds_of(level), 17.0**2)
    rng = np.random.default_rng(0)
    level = slope_level(rng.uniform(0.0, 40.0, SIZE).astype(np.float32))
    np.testing.assert_allclose(np.sqrt(thresholds_of(level, 0.5)), 27.0, atol=1.5)
    np.testing.assert_allclose(np.sqrt(thresholds_of(level, 0.9)), 43.0, atol=1.5)


def test_thresholds_are_smoothed_over_neighbouring_regions() -> None:
    slope = np.zeros(SIZE, np.float32)
    slope[64:96, 96:128] = 36.0
    raised = np.argwhere(thresholds_of(slope_level(slope)) > 7.0**2 + 1)
    assert raised.min(axis=0).tolist() == [1, 2]
    assert raised.max(axis=0).tolist() == [3, 4]


def test_the_strongest_pixel_of_a_cell_is_picked() -> None:
    slope = np.zeros(SIZE, np.float32)
    slope[42, 33], slope[41, 34] = 30.0, 50.0
    found = picked(slope_level(slope), thresholds_of(slope_level(slope)), 5)
    assert found.tolist() == [[34], [41], [1]]


def test_weaker_pixels_are_picked_where_a_whole_neighbourhood_is_empty() -> None:
    limit = 16.0
    thresholds = np.full_like(thresholds_of(slope_level(np.zeros(SIZE, np.float32))), limit**2)
    slope = np.zeros(SIZE, np.float32)
    slope[22, 22] = 0.8 * limit  # above 0.75 of the limit: for twice the cell
    slope[22, 82] = 0.6 * limit  # above 0.5625 of it: for four times
    slope[22, 142] = 0.5 * limit
    slope[102, 22] = 2 * limit  # its weaker neighbour in the same block is not needed
    slope[107, 22] = 0.8 * limit
    found = picked(slope_level(slope), thresholds, 5)
    assert sorted(found.T.tolist()) == [[22, 22, 2], [22, 102, 1], [82, 22, 4]]


def test_masked_pixels_are_never_picked() -> None:
    slope = np.full(SIZE, 40.0, np.float32)
    slope[::3] = 60.0
    found = picked(slope_level(slope), np.full((6, 8), 25.0, np.float32), 4)
    assert found.shape[1] > 1000
    assert np.all(margin_mask()[found[1], found[0]] == 1)


def test_picking_stops_when_the_table_is_full() -> None:
    level = slope_level(np.full(SIZE, 40.0, np.float32))
    assert picked(level, np.full((6, 8), 25.0, np.float32), 4, capacity=10).shape == (3, 10)


def test_picks_cover_the_image_and_repeat() -> None:
    level = level_of(Corner(0).image(MIDDLE, np.eye(4)))
    found = picked(level, thresholds_of(level), 5)
    cells = {(u // 40, v // 36) for u, v, _ in found.T}
    assert len(cells) == 30  # all of 6 x 5
    assert np.array_equal(found, picked(level, thresholds_of(level), 5))
    assert len({(u, v) for u, v, _ in found.T}) == found.shape[1]


def test_the_distance_map_is_within_the_chamfer_error() -> None:
    rng = np.random.default_rng(1)
    u = rng.uniform(0, 79, 12).astype(np.float32)
    v = rng.uniform(0, 59, 12).astype(np.float32)
    out = np.empty((60, 80), np.float32)
    ks.distance_map(u, v, 10, out)  # the last two are not asked for
    y, x = np.mgrid[:60, :80]
    px, py = np.floor(u[:10] + 0.5), np.floor(v[:10] + 0.5)
    exact = np.hypot(x[..., None] - px, y[..., None] - py).min(axis=-1)
    assert np.all(out >= exact - 1e-3)
    assert np.all(out <= exact * 1.09 + 1e-3)  # 1 and 1.4142 overrate knight's moves by 8.2 %


def test_without_points_everything_is_far() -> None:
    out = np.empty((20, 30), np.float32)
    ks.distance_map(np.zeros(0, np.float32), np.zeros(0, np.float32), 0, out)
    assert out.min() > 900.0


def test_accepted_points_keep_their_distance() -> None:
    rng = np.random.default_rng(2)
    u = rng.uniform(0, 79, 500).astype(np.float32)
    v = rng.uniform(0, 59, 500).astype(np.float32)
    distance = np.empty((60, 80), np.float32)
    given = (np.array([40.0], np.float32), np.array([30.0], np.float32))
    ks.distance_map(*given, 1, distance)
    taken = np.empty(500, np.uint8)
    count = ks.accept_spread(u, v, np.full(500, 6.0, np.float32), distance, taken, 1000)
    assert count == np.count_nonzero(taken)
    chosen = np.floor(np.column_stack((u, v))[taken > 0] + 0.5)
    points = np.vstack((chosen, [[40.0, 30.0]]))
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2) + 100.0 * np.eye(len(points))
    # Given points are known by their chamfer distance, which overrates by up to 8 %.
    assert gaps.min() >= 6.0 / 1.09
    # It is full: nobody who was left out would have had room.
    left = np.floor(np.column_stack((u, v))[taken == 0] + 0.5)
    assert np.linalg.norm(left[:, None] - points[None], axis=2).min(axis=1).max() < 6.0


def test_the_first_in_order_wins_and_the_capacity_holds() -> None:
    u, v = np.array([10.0, 11.0, 30.0, 50.0], np.float32), np.full(4, 10.0, np.float32)
    near, taken = np.full(4, 5.0, np.float32), np.empty(4, np.uint8)
    ks.accept_spread(u, v, near, np.full((20, 60), 1e3, np.float32), taken, 2)
    assert taken.tolist() == [1, 0, 1, 0]


@pytest.mark.parametrize(("u", "v"), [(-3.0, 5.0), (5.0, -3.0), (80.0, 5.0), (5.0, 60.0)])
def test_points_outside_are_not_accepted(u: float, v: float) -> None:
    taken = np.empty(1, np.uint8)
    args = (np.array([u], np.float32), np.array([v], np.float32), np.ones(1, np.float32))
    assert ks.accept_spread(*args, np.full((60, 80), 1e3, np.float32), taken, 5) == 0
