# SPDX-License-Identifier: Apache-2.0
"""Tracks fused to points, with what each observation turns out to be worth."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from edge.geometry import se3
from edge.types import F64, I32, Mat4
from maps.kernels_triangulate import triangulate
from maps.matching import MatchSide
from maps.settings import BuildSettings
from maps.tracks import Tracks

I64 = NDArray[np.int64]

_PASSES = 3
_SURE_VIEWS = 4
_SURE_OBSERVATIONS = 200
_LEAST_PX = 0.05  # no corner is known better, whatever few residuals say


class Accuracy(NamedTuple):
    """What an observation is worth: its variance is pose_px^2 + (corner_px * scale)^2."""

    corner_px: float  # deviation of a corner at octave 0; it grows with the octave's scale
    pose_px: float  # what errors of the given poses and of the lens add


class Points(NamedTuple):
    """Points with the observations that agree with them, sorted by point, then by view."""

    xyz: F64  # (n, 3) in the map frame
    covariance: F64  # (n, 3, 3)
    parallax_rad: F64  # (n,)
    offsets: I64  # (n + 1,)
    view: I32  # (m,)
    feature: I32  # (m,)
    residual_px: F64  # (m,)
    accuracy: Accuracy


def fuse(
    tracks: Tracks, poses: list[Mat4], sides: list[MatchSide], settings: BuildSettings
) -> Points:
    """Points of tracks: those that their views agree on, with honest covariances.

    The first pass believes `settings.sigma_px`; its residuals tell what corners and poses are
    worth, and the next one believes those.
    """
    accuracy = Accuracy(settings.sigma_px, 0.0)
    fused = _triangulate(tracks, poses, sides, settings, accuracy)
    for _ in range(_PASSES - 1):
        accuracy = _accuracy_of_residuals(fused, accuracy, settings.gate_chi2)
        fused = _triangulate(tracks, poses, sides, settings, accuracy)
    return _select(tracks, fused, poses, settings, accuracy)


class _Fused(NamedTuple):
    xyz: F64
    information: F64
    used: NDArray[np.bool_]
    parallax: F64
    residual: F64  # (m,) [px]
    scale: F64  # (m,) of the octave
    per_track: I64  # used observations
    track: I64  # (m,)


def _triangulate(
    tracks: Tracks,
    poses: list[Mat4],
    sides: list[MatchSide],
    settings: BuildSettings,
    accuracy: Accuracy,
) -> _Fused:
    T = np.array([se3.inverse(pose) for pose in poses])
    centres = np.array([pose[:3, 3] for pose in poses])
    K = np.array([[s.pinhole.fx, s.pinhole.fy, s.pinhole.cx, s.pinhole.cy] for s in sides])
    base = np.concatenate([[0], np.cumsum([len(side.rays) for side in sides])])
    row = base[tracks.view] + tracks.feature
    rays = np.concatenate([s.rays @ T[:3, :3].T for s, T in zip(sides, poses, strict=True)])[row]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    pixels = np.concatenate([side.pixels for side in sides])[row].astype(np.float64)
    scale = np.concatenate([side.sigma for side in sides])[row].astype(np.float64)
    depth = np.concatenate([side.depth for side in sides])[row]
    depth_sigma = np.concatenate([side.depth_sigma for side in sides])[row]
    n, m = len(tracks.offsets) - 1, len(row)
    xyz, information, parallax = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n)
    used = np.empty(m, np.uint8)
    corner = accuracy.corner_px * scale
    sigma = np.hypot(accuracy.pose_px, corner)
    # Poses near each other are wrong together, and residuals show only what they are wrong apart:
    # many views take the noise of corners out of a point, but not the error of the poses.
    views = np.repeat(np.diff(tracks.offsets), np.diff(tracks.offsets))
    shared = np.hypot(accuracy.pose_px * np.sqrt(views), corner)
    triangulate(
        T, K, centres, rays, tracks.offsets, tracks.view, pixels, sigma, shared,
        depth, depth_sigma, settings.gate_chi2, 2.0, xyz, information, used, parallax,
    )  # fmt: skip
    track = np.repeat(np.arange(n), np.diff(tracks.offsets))
    camera = np.einsum("mij,mj->mi", T[tracks.view, :3, :3], xyz[track]) + T[tracks.view, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = camera[:, :2] / camera[:, 2:] * K[tracks.view, :2] + K[tracks.view, 2:]
    residual = np.linalg.norm(seen - pixels, axis=1)
    is_used = used.astype(bool)
    return _Fused(
        xyz,
        information,
        is_used,
        parallax,
        residual,
        scale,
        np.bincount(track[is_used], minlength=n),
        track,
    )


def _accuracy_of_residuals(fused: _Fused, believed: Accuracy, gate: float) -> Accuracy:
    """Accuracy that the residuals show, from points of four or more views."""
    chosen = fused.used & (fused.per_track[fused.track] >= _SURE_VIEWS)
    if np.count_nonzero(chosen) < _SURE_OBSERVATIONS:
        return believed
    # Fitting three numbers takes away some of 2 n squared residuals; what is left is scaled up.
    n = fused.per_track[fused.track[chosen]]
    variance = 0.5 * fused.residual[chosen] ** 2 * (2.0 * n) / (2.0 * n - 3.0)
    # The gate has cut off the largest: this is the mean of a chi-square of two below it, over 2.
    variance /= 1.0 - 0.5 * gate / np.expm1(0.5 * gate)
    # One line through the octaves' mean variances over their squared scales.
    scale2, octave = np.unique(fused.scale[chosen] ** 2, return_inverse=True)
    counts = np.bincount(octave)
    means = np.bincount(octave, variance) / counts
    weights = np.sqrt(counts) / means
    line = np.stack((scale2, np.ones_like(scale2)), axis=1)
    (corner2, pose2), _ = nnls(line * weights[:, None], means * weights)
    return Accuracy(max(float(np.sqrt(corner2)), _LEAST_PX), float(np.sqrt(pose2)))


def _select(
    tracks: Tracks,
    fused: _Fused,
    poses: list[Mat4],
    settings: BuildSettings,
    accuracy: Accuracy,
) -> Points:
    """Leave out what is no point, or one of which the distance is not known."""
    n = len(fused.xyz)
    centres = np.array([pose[:3, 3] for pose in poses])
    first = np.full(n, -1)
    rows = np.flatnonzero(fused.used)[::-1]
    first[fused.track[rows]] = tracks.view[rows]
    sound = (first >= 0) & np.isfinite(fused.xyz).all(axis=1)
    information = np.where(sound[:, None, None], fused.information, np.eye(3))
    lower = np.tril(information)
    full = lower + np.tril(information, -1).transpose(0, 2, 1)
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", full), 1e-300))
    normal = full / (scale[:, :, None] * scale[:, None, :])
    sound &= np.linalg.eigvalsh(normal)[:, 0] > 1e-12
    normal = np.where(sound[:, None, None], normal, np.eye(3))
    covariance = np.linalg.inv(normal) / (scale[:, :, None] * scale[:, None, :])
    distance = np.linalg.norm(fused.xyz - centres[first], axis=1)
    covariance += np.eye(3) * (settings.pose_error * distance[:, None, None]) ** 2
    worst = np.sqrt(np.linalg.eigvalsh(np.where(sound[:, None, None], covariance, np.eye(3)))[:, 2])
    sound &= worst < settings.max_depth_error * distance
    kept = fused.used & sound[fused.track]
    counts = np.bincount(fused.track[kept], minlength=n)[sound]
    return Points(
        xyz=fused.xyz[sound],
        covariance=covariance[sound],
        parallax_rad=fused.parallax[sound],
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        view=tracks.view[kept],
        feature=tracks.feature[kept],
        residual_px=fused.residual[kept],
        accuracy=accuracy,
    )
