# SPDX-License-Identifier: Apache-2.0
"""Segments of one view matched with those of others of known pose, at least three at a time."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from edge.config.lines import ThreeViewConfig
from edge.lines import kernels_threeview
from edge.lines.line import Segments, ends
from edge.types import F32, F64, I32, U8, Mat4, Pinhole


class Drawn(NamedTuple):
    """The segments of one view and how their sides look."""

    segments: Segments
    grey: F32  # (n, 2, PROFILE) at the image's mean brightness


class Posed(NamedTuple):
    """A view with its segments."""

    drawn: Drawn
    T_cam_lines: Mat4


_MEAN_GREY = 128.0


def drawn(image: U8, segments: Segments) -> Drawn:
    """Segments of an image (h, w) with the looks of their sides, whatever its exposure."""
    grey = np.empty((len(segments.length), 2, kernels_threeview.PROFILE), np.float32)
    smooth = cv2.GaussianBlur(image, (3, 3), 0).astype(np.float32)
    kernels_threeview.profiles(smooth, ends(segments), grey)
    gain = np.float32(_MEAN_GREY / max(float(image.mean()), 1.0))
    return Drawn(segments, np.where(grey < 0.0, grey, gain * grey))


def match(
    first: Posed,
    others: Sequence[Posed],
    camera: Pinhole,
    depth_range: tuple[float, float],
    config: ThreeViewConfig,
) -> tuple[I32, F64]:
    """Segment (n, m) in each of m other views, -1 for none, and how many agree (n,).

    What fewer than two others show is left out: two views agree on a line whatever they show.
    camera : of all views
    depth_range : of the ends along the first camera's axis
    """
    n, m = len(first.drawn.segments.length), len(others)
    best, score = np.full((n, m), -1, np.int32), np.zeros(n)
    if n == 0 or m < 2:
        return best, score
    flat = [_flat(view.drawn.segments, camera) for view in others]
    start = np.cumsum([0] + [len(rows) for rows in flat]).astype(np.int32)
    R, t = first.T_cam_lines[:3, :3], first.T_cam_lines[:3, 3]
    T = np.empty((m, 3, 4))
    for k, view in enumerate(others):
        T[k, :, :3] = view.T_cam_lines[:3, :3] @ R.T
        T[k, :, 3] = view.T_cam_lines[:3, 3] - T[k, :, :3] @ t
    kernels_threeview.match(
        _flat(first.drawn.segments, camera),
        first.drawn.grey,
        start,
        np.concatenate(flat),
        np.concatenate([view.drawn.grey for view in others]),
        T,
        0.5 * (camera.fx + camera.fy),
        np.array(depth_range),
        config.reach_px,
        float(np.cos(np.deg2rad(config.angle_deg))),
        config.max_grey,
        best,
        score,
    )
    few = np.count_nonzero(best >= 0, axis=1) < 2
    best[few], score[few] = -1, 0.0
    return best, score


def _flat(segments: Segments, camera: Pinhole) -> F64:
    """Ends (n, 4) in focal lengths from the camera's axis."""
    centre, focal = np.tile([camera.cx, camera.cy], 2), np.tile([camera.fx, camera.fy], 2)
    return np.asarray((ends(segments) - centre) / focal, np.float64)
