# SPDX-License-Identifier: Apache-2.0
"""A start from the map: one frame with depths that the map told, and the frames since then."""

import itertools
import logging
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.image.pyramid import PyramidBuilder
from edge.odometry import anchors
from edge.odometry import candidates as cand
from edge.odometry import kernels_trace as ktr
from edge.odometry import kernels_window as kw
from edge.odometry.lens import as_found
from edge.odometry.motion import rates
from edge.odometry.reference import Reference
from edge.odometry.tracker import (
    Tracker,
    covariance_of,
    is_believable,
    motion_guesses,
    sigma_t_of,
)
from edge.odometry.window import Window
from edge.types import F32, F64, Bools, DepthSamples, Frame, KeyframePose, MapStart, Mat4, Pinhole

I64 = NDArray[np.int64]

log = logging.getLogger(__name__)

# What the map's own sigmas do not know of a depth: features are not quite on their points.
DEPTH_SIGMA_SHARE = 0.01
# Depths less certain than this (relative) are no seeds.
MAX_SIGMA_SHARE = 0.1
# Where rows that are read one after another turn further against each other, the fix is as wrong as
# its depths, and what is tracked by them takes turns for translations ever after.
MAX_ROWS_TURNED_RAD = 0.0165
# ... unless all the image fits one pose: rows that had turned would not. A global shutter's fast
# turns had 0.98 and more, those of a rolling one 0.73 to 0.96.
RIGID_INLIER_SHARE = 0.97
# What came nearer than this share of its depth is as good as behind the camera.
NEAR_SHARE = 0.1
# The residual that a tracker may expect before it has seen any.
FIRST_RESIDUAL_GREY = 12.0
NO_POINTS = np.zeros((3, 0), np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class MapSeed:
    """Frames in their order; the map told of the first."""

    frames: tuple[Frame, ...]
    told: MapStart


class Ahead(NamedTuple):
    """How far the start has followed the camera."""

    poses: tuple[KeyframePose, ...]  # of the frames after the first
    T_odom_cam: Mat4  # of the last frame
    T_cam_last: Mat4  # motion between the last two
    affine: F64
    residual_grey: float


def plant(window: Window, depth: DepthSamples, scale: float, projected: F32 = NO_POINTS) -> int:
    """Make points of the newest keyframe from depths in full-size pixels; how many.

    `scale` is full-size pixels per pixel of level 0; where points are already, at `projected`
    (3, n) u, v, inverse depth, none are made.
    """
    newest = window.keyframes[-1]
    relative = np.hypot(depth.sigma / depth.inverse_depth, np.float32(DEPTH_SIGMA_SHARE))
    pixels = (depth.pixels + np.float32(0.5)) / np.float32(scale) - np.float32(0.5)
    pixels = as_found(pixels.T, window.pinhole, newest.undistortion.radial).T
    chosen = _spread(pixels, relative, window, projected)
    table = np.zeros((ktr.CANDIDATE_ROWS, len(chosen)), np.float32)
    table[[kw.U, kw.V]] = np.rint(pixels[chosen]).T
    ktr.describe(
        window.images[newest.slot],
        np.float32(window.config.gradient_scale_grey),
        np.float32(window.config.outlier_grey),
        table,
    )
    idepth = depth.inverse_depth[chosen]
    table[kw.IDEPTH] = idepth
    information = anchors.information_of(relative[chosen] * idepth)
    f, n = len(window.keyframes), len(chosen)
    host = np.full(n, f - 1, np.int32)
    window.add_points(
        table, host, np.zeros((f, n), np.uint8), np.stack((idepth, information)).astype(np.float32)
    )
    return n


def seen_from(depth: DepthSamples, T_to_from: Mat4, pinhole: Pinhole, scale: float) -> DepthSamples:
    """The same points in another camera; `pinhole` is that of level 0, `scale` as in `plant`."""
    u, v = ((depth.pixels.astype(np.float64) + 0.5) / scale - 0.5).T
    rays = np.column_stack(((u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy))
    xyz = np.column_stack((rays, np.ones(len(rays)))) / depth.inverse_depth[:, None]
    xyz = se3.transform(T_to_from, xyz)
    ahead = xyz[:, 2] > NEAR_SHARE / depth.inverse_depth
    x, y, z = xyz[ahead].T
    at = np.column_stack((x / z * pinhole.fx + pinhole.cx, y / z * pinhole.fy + pinhole.cy))
    ratio = 1.0 / (z * depth.inverse_depth[ahead])
    return DepthSamples(
        pixels=((at + 0.5) * scale - 0.5).astype(np.float32),
        inverse_depth=(1.0 / z).astype(np.float32),
        sigma=(depth.sigma[ahead] * ratio).astype(np.float32),
    )


def follow(
    window: Window,
    reference: Reference,
    seed: MapSeed,
    builder: PyramidBuilder,
    tracker: Tracker,
    config: OdometryConfig,
    most_readout_s: float,
) -> Ahead | None:
    """Track the frames after the first against the seeds, and search the candidates in them.

    None where one cannot be tracked, or rows that are read within `most_readout_s` may turn far.
    """
    T_odom_cam, T_cam_last = reference.T_odom_cam, np.eye(4)
    affine, residual_grey = reference.affine, FIRST_RESIDUAL_GREY
    search_px = config.search_share * (builder.pinholes[0].width + builder.pinholes[0].height)
    poses: list[KeyframePose] = []
    for before, frame in itertools.pairwise(seed.frames):
        pyramid = builder.build(frame.image)
        T_guess = se3.inverse(T_odom_cam) @ reference.T_odom_cam
        # Noise of the map's fixes is larger than what a slow camera moves: its own motion first.
        T_told = se3.exp(seed.told.velocity * ((before.t_ns - frame.t_ns) * 1e-9))
        for T_moved in (T_cam_last, T_told):
            guesses = motion_guesses(T_guess, T_moved)
            tracked = tracker.track(pyramid, reference, guesses, affine, residual_grey)
            if is_believable(tracked, reference, config):
                break
        else:
            log.debug("start from the map lost frame=%d", frame.index)
            return None
        T_odom_last = T_odom_cam
        T_odom_cam = se3.normalise(reference.T_odom_cam @ se3.inverse(tracked.T_cam_reference))
        T_cam_last = se3.inverse(T_odom_cam) @ T_odom_last
        turning = rates(T_cam_last, frame.t_ns - before.t_ns).turning
        turned_rad = float(np.linalg.norm(turning)) * most_readout_s
        if turned_rad > MAX_ROWS_TURNED_RAD and tracked.inlier_share < RIGID_INLIER_SHARE:
            log.debug("start from the map turns too fast frame=%d", frame.index)
            return None
        affine, residual_grey = tracked.affine, max(2.0, tracked.residual_grey)
        sigma_t = sigma_t_of(covariance_of(tracked, config.covariance_factor))
        T_cam_odom = se3.inverse(T_odom_cam)
        cand.trace_all(window, pyramid.levels[0], T_cam_odom, affine, search_px, sigma_t)
        poses.append(KeyframePose(frame.index, T_odom_cam, frame.t_ns))
    return Ahead(tuple(poses), T_odom_cam, T_cam_last, affine, residual_grey)


def _spread(pixels: F32, relative: F32, window: Window, projected: F32) -> I64:
    """Indices of the samples to use: certain, inside, one in each free cell of 2 px, best first."""
    mask = window.mask
    height, width = mask.shape
    at = np.rint(pixels).astype(np.int64)
    inside = _inside(at, width, height) & (relative < MAX_SIGMA_SHARE)
    order = np.argsort(relative, kind="stable")
    order = order[inside[order]]
    order = order[mask[at[order, 1], at[order, 0]] > 0]
    there = np.rint(projected[:2].T).astype(np.int64)
    taken = _cells(there[_inside(there, width, height)], width)
    order = order[~np.isin(_cells(at[order], width), taken)]
    cells = _cells(at[order], width)
    return np.asarray(order[np.sort(np.unique(cells, return_index=True)[1])])


def _cells(at: I64, width: int) -> I64:
    return np.asarray((at[:, 1] // 2) * width + at[:, 0] // 2)


def _inside(at: I64, width: int, height: int) -> Bools:
    u, v = at.T
    return np.asarray((u >= 4) & (v >= 4) & (u < width - 4) & (v < height - 4))
