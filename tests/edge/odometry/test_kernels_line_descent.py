# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.odometry import bundle, line_structure
from edge.odometry.kernels_line_descent import descend
from edge.odometry.room_axes import Turned
from tests.edge.odometry.test_line_structure import FOCAL_PX, MOTIONS, poses, scene

LIMIT = 0.3 / FOCAL_PX


@pytest.mark.parametrize("rounds", [1, 6])
@pytest.mark.parametrize("directions", [0, 5])
def test_the_descent_goes_the_way_of_the_dense_one(rounds: int, directions: int) -> None:
    T = poses(MOTIONS["sideways and turning"])
    rng = np.random.default_rng(7)
    seen, idepth = scene(rng, 12, 5, T, 0.1)
    along = rng.normal(size=(directions, 3))
    planes = np.cross(np.stack([along @ pose[:3, :3].T for pose in T]), rng.normal(size=3))
    seen = seen._replace(turned=Turned(along, 0.1 * planes, np.empty((0, 3, 3))))
    begun = [se3.exp([0.01, 0.0, 0.0, 0.0, 0.0, 0.002]) @ pose for pose in T]
    flat = np.full(len(idepth), float(np.mean(idepth)))
    dense = bundle.descend(
        lambda at, depth: line_structure._system(seen, at, depth, LIMIT), begun, flat, rounds
    )
    assert dense is not None

    R = np.stack([pose[:3, :3] for pose in begun])
    t = np.stack([pose[:3, 3] for pose in begun])
    depth, squared = flat.copy(), np.empty((len(T), len(idepth)))
    seen_by = (seen.rays, seen.line, seen.visible, seen.turned.along, seen.turned.normal)
    cost = descend(*seen_by, LIMIT, 0.0, rounds, R, t, depth, squared)

    assert cost == pytest.approx(dense.system.cost, rel=1e-6)
    np.testing.assert_allclose(depth, dense.idepth, atol=1e-6)
    np.testing.assert_allclose(R, [pose[:3, :3] for pose in dense.poses], atol=1e-7)
    np.testing.assert_allclose(t, [pose[:3, 3] for pose in dense.poses], atol=1e-7)
    np.testing.assert_allclose(squared, dense.system.squared, atol=1e-9)


def test_depths_that_nothing_tells_stay_in_the_middle() -> None:
    T = poses(MOTIONS["sideways"])
    seen, idepth = scene(np.random.default_rng(8), 12, 4, T, 0.0)
    # An edge that moves along itself: any depths lie on it.
    seen.visible[:, :2] = 0
    R, t = np.stack([pose[:3, :3] for pose in T]), np.stack([pose[:3, 3] for pose in T])
    depth, squared = idepth.copy(), np.empty((len(T), len(idepth)))
    seen_by = (seen.rays, seen.line, seen.visible, seen.turned.along, seen.turned.normal)
    descend(*seen_by, LIMIT, 1e-7, 20, R, t, depth, squared)
    np.testing.assert_allclose(depth[:2], 1.0, atol=1e-3)
    ratio = depth[2:] / idepth[2:]  # the scale of all is nobody's
    np.testing.assert_allclose(ratio / np.median(ratio), 1.0, atol=0.03)
