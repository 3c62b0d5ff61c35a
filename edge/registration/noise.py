# SPDX-License-Identifier: Apache-2.0
"""How a fix errs: its pose and its scale, alone and together with others from near by."""

import math

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.geometry import so3
from edge.types import F64, Fix, Mat4

_POSE, _SCALE, _COMMON = 6, 6, 7
# Variances that errors are shared up to, in times of the best fixes'; above the last each has its
# own. From within a map to its edge they grow a hundredfold.
_LEVELS = np.array([1.0, 10.0, 100.0])


def pose_difference(T_a: Mat4, T_b: Mat4) -> F64:
    """Position and rotation (6,), in map axes, that lead from T_b to T_a."""
    return np.concatenate((T_a[:3, 3] - T_b[:3, 3], so3.log(T_a[:3, :3] @ T_b[:3, :3].T)))


def rotation_vectors(R: F64) -> F64:
    """Rotation vectors (n, 3) of rotations (n, 3, 3); their length alone where it is near pi."""
    axis = np.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), 1)
    length = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(length, np.trace(R, axis1=1, axis2=2) - 1.0)
    w = axis * np.where(angle < 1e-6, 0.5, angle / np.maximum(length, 1e-12))[:, None]
    w[(length < 1e-6) & (angle > 1.0)] = (math.pi, 0.0, 0.0)
    return np.asarray(w)


def noise_of(fix: Fix) -> tuple[F64, int]:
    """Covariance (7, 7) of a fix's pose and scale, and how many of its rows were measured.

    The scale from depths was taken at the fix's pose: if that stands too far ahead by dz, the
    map's depths are too small by dz and so is the scale. The two share one error, and the
    covariance says so, for else one piece of information would count twice.
    """
    assert fix.covariance is not None
    R7 = np.eye(7)
    R7[:_POSE, :_POSE] = fix.covariance
    if fix.log_scale is None or fix.log_scale_sigma is None:
        return R7, _POSE
    assert fix.T_map_cam is not None
    assert fix.depth_m is not None
    slope = np.zeros(_POSE)
    slope[:3] = -fix.T_map_cam[:3, 2] / fix.depth_m
    shared = fix.covariance @ slope
    R7[_SCALE, :_POSE] = R7[:_POSE, _SCALE] = shared
    R7[_SCALE, _SCALE] = fix.log_scale_sigma**2 + slope @ shared
    return R7, 7


def parts_of(R7: F64, config: RegistrationConfig) -> tuple[F64, F64]:
    """Roots (k, n, 7, 7) of what n fixes have in common, and what is left to each (n, 7, 7).

    R7  (n, 7, 7)  float64  their covariances

    Two fixes share a part of what the better of them errs by, as far as k levels tell them apart:
    each level is an error of its own, of those fixes alone that are so uncertain. If what is
    shared grew with a fix's own covariance, good ones would seem to tell the error of bad ones,
    and the difference of the two their common error, which nothing tells. If it were that of the
    best for all, bad ones that rest on the same points from afar would seem independent.
    """
    share = np.full(_COMMON, config.common_share)
    share[_SCALE] = config.common_scale_share
    common = np.sqrt(share)
    best = np.linalg.inv(np.linalg.inv(R7).mean(axis=0)) * np.outer(common, common)
    root = np.linalg.cholesky(R7)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ best @ inverse.swapaxes(1, 2))
    # Of no fix more than the share is common, in no direction.
    most = np.clip(_LEVELS[:, None, None] * values, 0.0, share.max())
    levels = np.diff(most, axis=0, prepend=0.0)
    turned = root @ vectors
    shared = (turned * levels[:, :, None, :]) @ turned.swapaxes(1, 2)
    return _roots(shared), R7 - shared.sum(axis=0)


def _roots(C: F64) -> F64:
    """Symmetric square roots (..., 7, 7) of positive semidefinite matrices."""
    values, vectors = np.linalg.eigh(C)
    scaled = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return np.asarray(scaled @ vectors.swapaxes(-1, -2), np.float64)
