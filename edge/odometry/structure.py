# SPDX-License-Identifier: Apache-2.0
"""Poses and inverse depths from tracked corners of a few frames, and how certain they are."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from edge.geometry import se3
from edge.odometry import kernels_start as ks
from edge.odometry.bundle import (
    NO_HUBER,
    State,
    System,
    depth_sigma,
    descend,
    goes_the_same_way,
    rescaled,
    reversed_relief,
)
from edge.types import F64, U8, Bools, Mat4

# Residual [in px of the image the corners were tracked in] that counts fully.
HUBER_PX = 1.0
# Steps of an adjustment at the most.
ROUNDS = 30
# A corner is tracked no better than this, whatever the residuals of a few frames say.
CORNER_SIGMA_PX = 0.25
# Other interpretations: baseline over depth that they start from, share of corners that must
# lie ahead of the camera.
GUESSED_BASELINE, MIN_AHEAD = 0.05, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """A first reconstruction in the reference frame; its median inverse depth is one."""

    T_frame_reference: tuple[Mat4, ...]
    inverse_depth: F64  # (n,)
    relative_sigma: F64  # (n,) standard deviation over inverse depth
    inlier: U8  # (n,) residual small in every frame
    residual_px: float  # root mean square of the inliers


def reconstruct(rays: F64, observed: F64, seen: U8, focal_px: float) -> Structure | None:
    """Reconstruct from normalised corners, or None where no consistent motion is found.

    rays      (n, 2)     in the reference frame
    observed  (m, n, 2)  in later frames, the newest last
    seen      (m, n)     uint8
    """
    first = _two_view(rays, observed[-1], focal_px)
    if first is None:
        return None
    T_last, idepth, ok = first
    m = len(observed)
    twist = se3.log(T_last)
    # Frames in between start on the straight way; the adjustment finds their own poses.
    share = _progress(rays, observed)
    poses = [se3.exp(share[k] * twist) for k in range(m)]
    seen = (seen * ok[None, :]).astype(np.uint8)
    result = _adjust(rays, observed, seen, poses, idepth, focal_px)
    if result is None:
        return None
    poses, idepth, squared = result.poses, result.idepth, result.system.squared
    residual = np.sqrt(squared) * focal_px
    good = ok & np.all((residual < 3.0 * HUBER_PX) | (seen == 0), axis=0) & (idepth > 0)
    if np.count_nonzero(good) < 20:
        return None
    seen = (seen * good[None, :]).astype(np.uint8)
    result = _adjust(rays, observed, seen, poses, idepth, focal_px)
    if result is None:
        return None
    poses, idepth, squared = result.poses, result.idepth, result.system.squared
    good &= idepth > 0
    if np.count_nonzero(good) < 20:
        return None
    used = (seen > 0) & (idepth > 0)[None, :]
    rms = float(np.sqrt(np.mean(squared[used]))) * focal_px
    system = _system(rays, observed, seen, poses, idepth, NO_HUBER)
    sigma = depth_sigma(system, poses, max(rms, CORNER_SIGMA_PX) / focal_px)
    scale = float(np.median(idepth[good]))
    return Structure(
        T_frame_reference=rescaled(poses, scale),
        inverse_depth=idepth / scale,
        relative_sigma=sigma / np.maximum(idepth, 1e-9),
        inlier=good.astype(np.uint8),
        residual_px=rms,
    )


def rival_residual(
    structure: Structure, rays: F64, observed: F64, seen: U8, focal_px: float
) -> float:
    """Least root mean square residual [px] of other interpretations of the same corners.

    Arguments as of `reconstruct`; only the structure's inliers are looked at.
    Seen from little motion, a scene looks much like its reversed relief with the opposite
    translation (a flow t d + w is also that of -t, 2 m - d and w + 2 m t), and a search from
    one side may end in a hollow of its own. So the adjustment is begun from the reversed
    relief and from flat ones with the camera gone to each side.
    """
    used = structure.inlier > 0
    rays, observed, seen = rays[used], observed[:, used], np.ascontiguousarray(seen[:, used])
    idepth, poses = structure.inverse_depth[used], structure.T_frame_reference
    mean = float(np.mean(idepth))
    starts = [
        (np.maximum(2.0 * mean - idepth, 0.1 * mean), [reversed_relief(T, mean) for T in poses])
    ]
    share = _progress(rays, observed)
    moved = np.nanmean(np.where(seen[..., None] > 0, observed - rays[None], np.nan), axis=1)
    for direction in np.vstack((np.eye(3), -np.eye(3))):
        sides = [GUESSED_BASELINE * s * direction for s in share]
        turns = [[t[1] - m[1], m[0] - t[0], 0.0] for t, m in zip(sides, moved, strict=True)]
        guess = [se3.exp(np.array([*t, *w])) for t, w in zip(sides, turns, strict=True)]
        starts.append((np.ones(len(rays)), guess))
    least = np.inf
    for depth, guess in starts:
        result = _adjust(rays, observed, seen, guess, depth, focal_px)
        if result is None or np.mean(result.idepth > 0) < MIN_AHEAD:
            continue
        if goes_the_same_way(result.poses[-1], poses[-1]):
            continue
        least = min(least, float(np.sqrt(np.mean(result.system.squared[seen > 0]))) * focal_px)
    return least


def _progress(rays: F64, observed: F64) -> F64:
    """How far along the motion each frame is, from the mean displacement of corners."""
    moved = np.linalg.norm(np.median(observed - rays[None], axis=1), axis=1)
    spread = np.median(np.linalg.norm(observed - rays[None], axis=2), axis=1)
    total = moved + spread
    return np.asarray(np.clip(total / max(total[-1], 1e-12), 0.0, 1.0))


def _two_view(rays: F64, other: F64, focal_px: float) -> tuple[Mat4, F64, Bools] | None:
    threshold = 1.0 / focal_px
    E, mask = cv2.findEssentialMat(
        rays, other, np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=threshold
    )
    if E is None or E.shape[0] < 3:
        return None
    best: tuple[int, Mat4, F64, Bools] | None = None
    for k in range(E.shape[0] // 3):
        _, R, t, front = cv2.recoverPose(E[3 * k : 3 * k + 3], rays, other, mask=mask.copy())
        T = se3.from_rotation_translation(R, t.ravel())
        idepth = _triangulate(rays, other, T)
        ok = (idepth > 0) & (front.ravel() > 0)
        count = int(np.count_nonzero(ok))
        if best is None or count > best[0]:
            best = (count, T, idepth, ok)
    if best is None or best[0] < 20:
        return None
    _, T, idepth, ok = best
    idepth = np.where(ok, idepth, np.median(idepth[ok]))
    return T, idepth, ok


def _triangulate(rays: F64, other: F64, T: Mat4) -> F64:
    """Inverse depths (n,) along the rays by least squares in the other image."""
    a = np.column_stack((rays, np.ones(len(rays)))) @ T[:3, :3].T
    t = T[:3, 3]
    # other_x (a_z + t_z d) = a_x + t_x d, and the same in y.
    cx, cy = t[0] - other[:, 0] * t[2], t[1] - other[:, 1] * t[2]
    rx, ry = other[:, 0] * a[:, 2] - a[:, 0], other[:, 1] * a[:, 2] - a[:, 1]
    return np.asarray((cx * rx + cy * ry) / np.maximum(cx * cx + cy * cy, 1e-12))


def _system(
    rays: F64, observed: F64, seen: U8, poses: Sequence[Mat4], idepth: F64, huber: float
) -> System:
    m, n = seen.shape
    T = np.stack(poses)
    H, b, W = np.empty((6 * m, 6 * m)), np.empty(6 * m), np.empty((6 * m, n))
    Hd, bd, squared = np.empty(n), np.empty(n), np.empty((m, n))
    R, t = np.ascontiguousarray(T[:, :3, :3]), np.ascontiguousarray(T[:, :3, 3])
    cost = ks.accumulate(rays, idepth, observed, seen, R, t, huber, H, b, Hd, bd, W, squared)
    return System(cost, H, b, W, Hd, bd, squared)


def _adjust(
    rays: F64, observed: F64, seen: U8, poses: Sequence[Mat4], idepth: F64, focal_px: float
) -> State | None:
    huber = HUBER_PX / focal_px
    return descend(
        lambda T, depth: _system(rays, observed, seen, T, depth, huber), poses, idepth, ROUNDS
    )
