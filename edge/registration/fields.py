# SPDX-License-Identifier: Apache-2.0
"""How fixes and the odometry between them err together: covariances over several places.

Rows come in sevens, one for each place: position (3) and rotation (3) in map axes, ln scale.
"""

import math
from typing import NamedTuple

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.types import F64

ROWS = 7
_POSE = 6
# Of rotation and scale that walk at random along a way, their mean over it: how it goes with
# their value at the end, and what is left.
_MEAN_BY_END, _MEAN_REST = 0.5, math.sqrt(1.0 / 12.0)


class Places(NamedTuple):
    """Where n frames are, in the axes of one of them and in depths of the scene."""

    position: F64  # (n, 3)
    turned: F64  # (n, k) points as far apart as the frames are turned [rad]
    way: F64  # (n, 2) path and sum of all turns up to there


def turned(T: F64) -> F64:
    """Points (n, 9) as far apart as the rotations of T (n, 4, 4), by their chords [rad]."""
    return np.asarray(T[:, :3, :3].reshape(-1, 9) / math.sqrt(2.0))


def drift(places: Places, away: F64, depth_m: float, config: RegistrationConfig) -> F64:
    """Covariances (2, 7 n, 7 n) of the odometry from the last of n + 1 places to the others.

    The first is of a way that shifts, the second of one that bends: what wanders in it is
    rotation and scale, which move the position as well. Cameras differ in one as in the other.

    `away` (n, 3) are the others' positions from the last one, in map units and axes.
    The odometry's error is a random field: its increments have a variance that grows with the
    distance of two places, since a window holds them against one another, and in part with the
    path.
    """
    n, share = len(away), config.drift_path_share
    moved = (1.0 - share) * _apart(places.position) + share * _apart(places.way[:, :1])
    turning = (1.0 - share) * _apart(places.turned) + share * _apart(places.way[:, 1:])
    position = np.zeros((n, ROWS, 3))
    position[:, :3] = config.drift_position_depth_share * depth_m * np.eye(3)
    scale, rotation = np.zeros((n, ROWS, 2)), np.zeros((n, ROWS, 6))
    scale[:, :3, 0], scale[:, 6, 0] = _MEAN_BY_END * away, 1.0
    scale[:, :3, 1] = _MEAN_REST * away
    lever = -hats(away)
    rotation[:, :3, :3], rotation[:, 3:6, :3] = _MEAN_BY_END * lever, np.eye(3)
    rotation[:, :3, 3:] = _MEAN_REST * lever
    bend = _field(moved, config.drift_log_scale * scale)
    bend += _field(moved + turning, config.drift_rotation_rad * rotation)
    return np.stack((_field(moved, position), bend))


def shared(roots: F64, places: Places, config: RegistrationConfig) -> F64:
    """Covariance (7 n, 7 n) of the errors that fixes at n places have in common.

    roots  (k, n, 7, 7)  float64  roots of each fix's share in k errors
    """
    forgetting = _apart(places.position) / config.common_path_depth_share
    forgetting += _apart(places.turned) / math.radians(config.common_turn_deg)
    columns = np.moveaxis(roots, 0, 2).reshape(-1, len(roots), ROWS)
    pose, scale = (
        part.reshape(len(columns), -1) for part in (columns[:, :, :_POSE], columns[:, :, _POSE:])
    )
    of_pose = _by_places(np.exp(-forgetting), pose @ pose.T)
    return of_pose + _by_places(np.exp(-forgetting / config.common_scale_keeps), scale @ scale.T)


def hats(v: F64) -> F64:
    """Matrices (n, 3, 3) of the cross products with v (n, 3)."""
    H = np.zeros((len(v), 3, 3))
    H[:, 2, 1], H[:, 0, 2], H[:, 1, 0] = v.T
    return H - H.swapaxes(1, 2)


def _field(variogram: F64, columns: F64) -> F64:
    """Covariance of a random field's increments from the last place, each through its columns.

    variogram  (n + 1, n + 1)  float64  variance of the increments
    columns    (n, 7, k)       float64  what a unit of each of k fields does there
    """
    K = 0.5 * (variogram[:-1, -1:] + variogram[-1:, :-1] - variogram[:-1, :-1])
    flat = columns.reshape(-1, columns.shape[2])
    return _by_places(K, flat @ flat.T)


def _apart(points: F64) -> F64:
    off = points[:, None] - points[None]
    return np.asarray(np.sqrt(np.einsum("ijk,ijk->ij", off, off)))


def _by_places(factors: F64, C: F64) -> F64:
    """C (7 n, 7 n) with each pair of places' block times its factor of (n, n)."""
    n = len(factors)
    blocks = factors[:, None, :, None] * C.reshape(n, ROWS, n, ROWS)
    return np.asarray(blocks.reshape(C.shape))
