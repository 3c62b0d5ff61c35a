# SPDX-License-Identifier: Apache-2.0
"""Pools of map points for tests that need no map."""

import numpy as np

from edge.relocalise.pool import Pool, packed
from tests.edge.relocalise.room_matches import CAMERA

SCALE_FACTOR = 1.2


def pool_of(xyz: np.ndarray, covariance: np.ndarray, T_seen_from: np.ndarray) -> Pool:
    """Points, each seen once from one keyframe on octave 0."""
    n = len(xyz)
    ray = xyz - T_seen_from[:3, 3]
    depth = ray @ T_seen_from[:3, 2]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return Pool(
        np.zeros(1, np.int32),
        np.zeros((n, 4), np.uint64),
        ray,
        np.zeros((n, 3)),
        np.zeros((n, 2)),
        np.zeros(n, np.int32),
        np.arange(n, dtype=np.int32),
        np.zeros(n, np.float32),
        np.zeros(n, np.float32),
        depth / CAMERA.fx,
        np.arange(n, dtype=np.int32),
        xyz,
        packed(covariance),
    )
