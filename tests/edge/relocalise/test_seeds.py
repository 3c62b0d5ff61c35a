# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.relocalise.assessment import Solution
from edge.relocalise.match import Matches
from edge.relocalise.seeds import depths
from tests.edge.relocalise.pools import pool_of
from tests.edge.relocalise.room_matches import CAMERA


def test_depths_of_the_inliers_are_those_from_the_pose() -> None:
    rng = np.random.default_rng(0)
    n = 50
    T = se3.exp(rng.normal(size=6))
    pixels = rng.uniform((20, 20), (620, 460), (n, 2))
    depth = rng.uniform(1.0, 4.0, n)
    rays = (pixels - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx
    xyz = se3.transform(T, np.column_stack((rays * depth[:, None], depth)))
    pool = pool_of(xyz, np.tile(4e-4 * np.eye(3), (n, 1, 1)), T)
    row = rng.permutation(n).astype(np.int32)
    found = Matches(np.arange(n, dtype=np.int32), row, np.zeros(n, np.int32))
    inlier = rng.random(n) < 0.7
    solution = Solution(T, np.eye(6), inlier, 1.0, 1.0, 9, 0.2, 2.0)

    told = depths(pool, found, solution, CAMERA)

    assert told.pixels == pytest.approx(pixels[row[inlier]], abs=1e-2)
    assert 1.0 / told.inverse_depth == pytest.approx(depth[row[inlier]], rel=1e-4)
    assert told.sigma / told.inverse_depth**2 == pytest.approx(0.02, rel=1e-3)
    assert not told.inverse_depth.flags.writeable
