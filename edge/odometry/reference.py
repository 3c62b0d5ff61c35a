# SPDX-License-Identifier: Apache-2.0
"""What frames are tracked against: a keyframe with depths at every pyramid level."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.image.pyramid import Pyramid
from edge.odometry import kernels_reference as kr
from edge.odometry.plain import Smoother, smoothing
from edge.types import F32, F64, U8, Mat4, Pinhole

# Tracking points of a level at most; dilation makes some five of each projected point.
MAX_TRACKING_POINTS = 12_000


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """A keyframe ready to be tracked against. Never changed after it was made."""

    index: int  # of its frame
    T_odom_cam: Mat4
    affine: F64  # (2,) a, b
    points: tuple[F32, ...]  # per level (5, n), as of `kernels_track.accumulate`
    inverse_depth: float  # their median; 0 if there are none
    smoothing: float = 0.0  # of its image, and so of those that are tracked


def make_reference(
    index: int,
    T_odom_cam: Mat4,
    affine: F64,
    pyramid: Pyramid,
    masks: Sequence[U8],
    pinholes: Sequence[Pinhole],
    projected: F32,
    weight: F32,
) -> Reference:
    """Spread projected points over the pyramid of their keyframe.

    projected  (3, n)  float32  u, v, inverse depth at level 0
    weight     (n,)    float32  how certain each inverse depth is; 0 leaves it out
    """
    depth = np.zeros(masks[0].shape, np.float32)
    total = np.zeros(masks[0].shape, np.float32)
    kr.splat(projected, weight, depth, total)
    offset = np.float32(affine[1])
    share = smoothing(pyramid.levels[0], masks[0])
    images = Smoother().smoothed(pyramid.levels, share)
    levels: list[F32] = []
    scratch = np.empty((5, MAX_TRACKING_POINTS), np.float32)
    for i, (level, mask, pinhole) in enumerate(zip(images, masks, pinholes, strict=True)):
        if i > 0:
            finer_depth, finer_total = depth, total
            depth = np.zeros(mask.shape, np.float32)
            total = np.zeros(mask.shape, np.float32)
            kr.halve_sums(finer_depth, finer_total, depth, total)
        intrinsics = intrinsics_of(pinhole)
        n = kr.collect(level, mask, depth, total, intrinsics, offset, 2 if i < 2 else 1, scratch)
        levels.append(np.ascontiguousarray(scratch[:, :n]))
    inverse_depth = float(np.median(levels[0][2])) if levels[0].size else 0.0
    return Reference(
        index, T_odom_cam, np.array(affine), tuple(levels), inverse_depth, smoothing=share
    )


def intrinsics_of(pinhole: Pinhole) -> F32:
    """Intrinsics as kernels take them: (4,) float32 fx fy cx cy."""
    return np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy], np.float32)
