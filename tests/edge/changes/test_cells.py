# SPDX-License-Identifier: Apache-2.0
"""Space in cubes."""

import numpy as np

from edge.changes.cells import cell_keys, cell_means

CELL_M = 0.05


def test_places_share_a_key_just_where_they_share_a_cube() -> None:
    rng = np.random.default_rng(3)
    xyz = rng.uniform(-0.2, 0.2, (400, 3))
    keys = cell_keys(xyz, CELL_M)
    cubes = np.floor(xyz / CELL_M)

    same = (cubes[:, None] == cubes[None]).all(axis=2)

    assert np.array_equal(keys[:, None] == keys[None], same)


def test_far_places_on_both_sides_of_the_origin_keep_their_own_keys() -> None:
    steps = np.array([-20_000.0, -0.01, 0.01, 20_000.0])
    xyz = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)

    assert len(set(cell_keys(xyz, CELL_M).tolist())) == len(xyz)


def test_the_mean_of_each_cube_lies_in_it() -> None:
    xyz = np.random.default_rng(4).uniform(-1.0, 1.0, (500, 3))
    keys = cell_keys(xyz, 0.3)

    cells, means = cell_means(keys, xyz)

    assert np.array_equal(cells, np.unique(keys))
    assert np.array_equal(cell_keys(means, 0.3), cells)
    assert np.allclose(means[cells == keys[0]][0], xyz[keys == keys[0]].mean(axis=0))
