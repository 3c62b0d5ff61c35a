# SPDX-License-Identifier: Apache-2.0
"""A camera pose from 2D-3D matches: searched among wrong ones, led from a rough one, settled."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.config.relocalise import RelocaliseConfig
from edge.geometry.se3 import from_rotation_translation
from edge.relocalise import kernels_pose, kernels_ransac
from edge.relocalise.assessment import Solution, assessed, clutter_px2, distances, gain_of
from edge.relocalise.correspondences import NO_KERNEL, Correspondences, parts_of
from edge.relocalise.stability import stability
from edge.types import F64, I32, Mat4, Pinhole

Bools = NDArray[np.bool_]
_STEPS = 20
# Squared robust scales by which a start some pixels off is led home.
_COARSE_TO_FINE = (400.0, 60.0)
# A pose that explains so many of the matches is not looked for with wider kernels.
_ENOUGH_SHARE = 0.7
_BETTER_GAIN = 1.0  # a pose found without a part of the image must explain so much more


def search(
    matches: Correspondences,
    promising: I32,
    camera: Pinhole,
    seed: int,
    config: RelocaliseConfig,
) -> tuple[Mat4, float] | None:
    """Pose that explains the matches best, and its gain; None where none explains any.

    `promising` (n,) lists the matches, those most likely right first.
    """
    if len(promising) < 4:
        return None
    bearings = np.ones((len(matches.pixels), 3))
    bearings[:, 0] = (matches.pixels[:, 0] - camera.cx) / camera.fx
    bearings[:, 1] = (matches.pixels[:, 1] - camera.cy) / camera.fy
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    R, p = np.eye(3), np.zeros(3)
    gain, _ = kernels_ransac.search(
        *matches[:4],
        bearings,
        promising,
        camera,
        seed,
        config.max_rounds,
        clutter_px2(camera),
        config.gate_chi2,
        R,
        p,
    )
    return (from_rotation_translation(R, p), float(gain)) if gain > 0.0 else None


def unexplained(
    matches: Correspondences, T_map_cam: Mat4, camera: Pinhole, config: RelocaliseConfig
) -> Bools:
    """Whether each match (n,) is far from what a pose predicts."""
    m2, _ = distances(matches, camera, *parts_of(T_map_cam))
    return np.asarray(m2 > 4.0 * config.gate_chi2, np.bool_)


def solve_from(
    T_map_cam: Mat4,
    matches: Correspondences,
    camera: Pinhole,
    config: RelocaliseConfig,
    *,
    coarse: bool = True,
) -> Solution | None:
    """Best pose near `T_map_cam`; None where the matches do not hold one.

    With `coarse` it may lie many pixels off, and what its covariance says is rough. Without,
    the pose is tried without parts of the image, and the covariance knows how it then moves.
    """
    if coarse:
        led = lead(T_map_cam, matches, camera, config)
        return assessed(led.T_map_cam, matches, None, camera, config)
    T, gain = _best_refined([T_map_cam], matches, camera, (), config)
    parts = stability(T, matches, _inliers(T, matches, camera, config), camera, config)
    if parts.others:
        T_other, gain_other = _best_refined(parts.others, matches, camera, (), config)
        if gain_other > gain + _BETTER_GAIN:
            T = T_other
            parts = stability(T, matches, _inliers(T, matches, camera, config), camera, config)
    return assessed(T, matches, parts.covariance, camera, config)


class Led(NamedTuple):
    """A pose to which a nearby one led."""

    T_map_cam: Mat4
    gain: float
    share: float  # of the matches that it explains


def lead(
    T_map_cam: Mat4, matches: Correspondences, camera: Pinhole, config: RelocaliseConfig
) -> Led:
    """Best pose that can be reached from one that may lie many pixels off."""
    # A few exact but wrong matches can drag a pose that is far off to where they fit: it is led
    # home by the wide kernel, and without it, and what explains more is right.
    plain = _led(T_map_cam, matches, camera, (), config)
    if plain.share >= _ENOUGH_SHARE:
        return plain
    scales = (*_COARSE_TO_FINE, config.gate_chi2)
    wide = _led(T_map_cam, matches, camera, scales, config)
    return wide if wide.gain > plain.gain else plain


def _led(
    T_map_cam: Mat4,
    matches: Correspondences,
    camera: Pinhole,
    scales: tuple[float, ...],
    config: RelocaliseConfig,
) -> Led:
    T, gain = _best_refined([T_map_cam], matches, camera, scales, config)
    share = float(np.mean(_inliers(T, matches, camera, config))) if len(matches.pixels) else 0.0
    return Led(T, gain, share)


def _inliers(
    T_map_cam: Mat4, matches: Correspondences, camera: Pinhole, config: RelocaliseConfig
) -> F64:
    m2, _ = distances(matches, camera, *parts_of(T_map_cam))
    return (m2 < config.gate_chi2).astype(np.float64)


def _best_refined(
    starts: list[Mat4],
    matches: Correspondences,
    camera: Pinhole,
    scales: tuple[float, ...],
    config: RelocaliseConfig,
) -> tuple[Mat4, float]:
    """Pose, of those near the starts, that explains most, and its gain."""
    found = [_refined(T, matches, camera, scales, config) for T in starts]
    gains = [gain_of(matches, T, camera, config) for T in found]
    best = int(np.argmax(gains))
    return found[best], gains[best]


def _refined(
    T_map_cam: Mat4,
    matches: Correspondences,
    camera: Pinhole,
    scales: tuple[float, ...],
    config: RelocaliseConfig,
) -> Mat4:
    """Pose at the least cost near by: by Cauchy kernels of `scales`, then by inliers alone."""
    R, p = parts_of(T_map_cam)
    H = np.empty((6, 6))
    use = np.ones(len(matches.pixels))
    for scale in scales:
        kernels_pose.refine(*matches[:4], use, camera, R, p, scale, NO_KERNEL, _STEPS, H)
    kernels_pose.refine(*matches[:4], use, camera, R, p, NO_KERNEL, config.gate_chi2, _STEPS, H)
    return from_rotation_translation(R, p)


def pixel_variance(octave: NDArray[np.uint8], scale_factor: float, config: RelocaliseConfig) -> F64:
    """Variance (n,) [px^2] of features found at the given octaves."""
    return (config.sigma_px * scale_factor ** octave.astype(np.float64)) ** 2
