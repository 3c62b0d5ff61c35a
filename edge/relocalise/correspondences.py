# SPDX-License-Identifier: Apache-2.0
"""Matches as the solvers take them."""

from typing import NamedTuple

import numpy as np

from edge.geometry import so3
from edge.types import F64, Mat4

NO_KERNEL = 1e15  # a robust scale that makes nothing robust


class Correspondences(NamedTuple):
    """Matches as the solver takes them."""

    pixels: F64  # (n, 2) ideal
    xyz: F64  # (n, 3) map points [m]
    C: F64  # (n, 6) their covariance: xx xy xz yy yz zz [m^2]
    variance: F64  # (n,) of each pixel [px^2]
    axis: F64  # (n, 3) one sigma of each point along the ray that the map saw it on [m]
    lens: F64  # (n, 2, 2) shift by one sigma of the focal length, and of distortion [px]


def parts_of(T: Mat4) -> tuple[F64, F64]:
    """Rotation (3, 3) and translation (3,) of a pose, as kernels take them; copies."""
    return np.array(T[:3, :3], order="C"), np.array(T[:3, 3])


def pose_difference(T_a: Mat4, T_b: Mat4) -> F64:
    """Position and rotation (6,), in map axes, that lead from T_b to T_a."""
    turn = so3.log(T_a[:3, :3] @ T_b[:3, :3].T)
    return np.concatenate((T_a[:3, 3] - T_b[:3, 3], turn))
