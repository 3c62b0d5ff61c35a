# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.relocalise.kernels_neighbours import nearest_samples


def test_the_nearest_is_that_of_all_distances_and_of_two_alike_the_first() -> None:
    rng = np.random.default_rng(0)
    # On a coarse grid many are equally near, some exactly at the radius.
    samples = rng.integers(0, 30, (150, 2)).astype(np.float32)
    pixels = rng.integers(-5, 36, (200, 2)).astype(np.float64)
    order = np.argsort(samples[:, 1], kind="stable")
    nearest = np.empty(200, np.int64)
    nearest_samples(pixels, samples, order, samples[order, 1].astype(np.float64), 3.0, nearest)
    square = ((pixels[:, None] - samples[None]) ** 2).sum(axis=2)
    expected = np.where(square.min(axis=1) <= 9.0, square.argmin(axis=1), -1)
    assert np.array_equal(nearest, expected)
    assert 10 < np.count_nonzero(nearest < 0) < 190


def test_no_samples_are_near_nothing() -> None:
    nearest = np.zeros(3, np.int64)
    none = np.zeros(0, np.int64)
    nearest_samples(np.zeros((3, 2)), np.zeros((0, 2), np.float32), none, np.zeros(0), 3.0, nearest)
    assert np.array_equal(nearest, [-1, -1, -1])
