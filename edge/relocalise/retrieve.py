# SPDX-License-Identifier: Apache-2.0
"""Which keyframes of the map may show what an image shows."""

import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.relocalise.bow import Vocabulary
from edge.relocalise.features import Features
from edge.relocalise.pool import PoolMaker
from edge.tiles.reader import Map
from edge.types import F64, Mat4

# One scene depth of distance costs as much as this angle between the views.
_ANGLE_PER_DEPTH_RAD = 0.8


def by_words(
    map_: Map, vocabulary: Vocabulary, features: Features, config: RelocaliseConfig
) -> list[int]:
    """Keyframes that share the image's words, best first, then those that see the same points."""
    vector = vocabulary.describe(features.descriptors)
    retrieved, _ = map_.bow.query(vector, config.retrieved)
    keyframes = [int(k) for k in retrieved]
    for k in tuple(keyframes):
        neighbours, _ = map_.covisible(k)
        for neighbour in neighbours[: config.covisible].tolist():
            if len(keyframes) >= config.pooled:
                return keyframes
            if neighbour not in keyframes:
                keyframes.append(neighbour)
    return keyframes


def near(map_: Map, pools: PoolMaker, T_map_cam: Mat4, count: int) -> list[int]:
    """Keyframes that look at the same things as a camera at `T_map_cam`, most alike first."""
    angle = _angles(map_.T_map_cam, T_map_cam)
    distance = np.linalg.norm(map_.T_map_cam[:, :3, 3] - T_map_cam[:3, 3], axis=1)
    # The nearest keyframe that looks the same way knows how deep the scene is.
    order = np.lexsort((np.arange(len(angle)), distance, angle > _ANGLE_PER_DEPTH_RAD))
    depth_m = pools.depth_m(int(order[0]))
    cost = distance / depth_m + angle / _ANGLE_PER_DEPTH_RAD
    nearest = np.lexsort((np.arange(len(cost)), cost))[:count]
    return [int(k) for k in nearest]


def _angles(poses: F64, T_map_cam: Mat4) -> F64:
    """Angle (k,) [rad] between the optical axes of poses (k, 4, 4) and of `T_map_cam`."""
    cosine = np.clip(poses[:, :3, 2] @ T_map_cam[:3, 2], -1.0, 1.0)
    return np.asarray(np.arccos(cosine), np.float64)
