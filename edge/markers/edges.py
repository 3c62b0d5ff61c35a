# SPDX-License-Identifier: Apache-2.0
"""Corners of a square marker from its edges: without the pull inwards of corner detectors."""

import cv2
import numpy as np

from edge.types import F64, U8

_ALONG = 24  # profiles across each side
_ENDS = 0.12  # part of a side at each end that is left out: corners are round
_STEP_PX = 0.25
_MAX_REACH_PX = 3.0
_REACH_MODULES = 0.6  # the black frame is one module wide
_MIN_CONTRAST_GREY = 25.0
_ROUNDS = 3


def refine_corners(image: U8, corners: F64, modules: int) -> F64:
    """Corners (4, 2) [px] where the lines along the sides meet; as given where edges are poor.

    image : (h, w), of a dark marker on light ground
    corners : (4, 2) within a pixel or so
    modules : of the marker's side, its black frame included
    """
    refined = corners
    for _ in range(_ROUNDS):
        lines = [_line(image, refined[k], refined[(k + 1) % 4], modules) for k in range(4)]
        if any(line is None for line in lines):
            return corners
        found = [line for line in lines if line is not None]
        refined = np.array([_crossing(found[k - 1], found[k]) for k in range(4)])
    if not np.all(np.abs(refined - corners) < _MAX_REACH_PX):
        return corners
    return refined


def _line(image: U8, a: F64, b: F64, modules: int) -> F64 | None:
    """Line (3,) with `line @ (u, v, 1) = 0` along the edge from `a` to `b`."""
    length = float(np.linalg.norm(b - a))
    if length < 2.0 * modules:
        return None
    along = (b - a) / length
    outwards = np.array([along[1], -along[0]])  # corners go clockwise, v points down
    reach = min(_MAX_REACH_PX, _REACH_MODULES * length / modules)
    places = a + np.linspace(_ENDS, 1.0 - _ENDS, _ALONG)[:, None] * (b - a)
    offsets = np.arange(-reach, reach + 0.5 * _STEP_PX, _STEP_PX)
    grid = (places[:, None] + offsets[None, :, None] * outwards).astype(np.float32)
    profile = cv2.remap(image, grid, None, cv2.INTER_LINEAR).astype(np.float64)
    ends = max(2, len(offsets) // 8)
    dark, light = profile[:, :ends].mean(axis=1), profile[:, -ends:].mean(axis=1)
    good = light - dark > _MIN_CONTRAST_GREY
    if np.count_nonzero(good) < _ALONG // 2:
        return None
    # The share of a profile that is dark says where its edge is, however blurred.
    share = (light[good, None] - profile[good]) / (light - dark)[good, None]
    edge = offsets[0] - 0.5 * _STEP_PX + _STEP_PX * share.sum(axis=1)
    edge = edge[:, None] * outwards + places[good]
    middle = np.median(edge @ outwards)
    edge = edge[np.abs(edge @ outwards - middle) < reach]
    if len(edge) < _ALONG // 2:
        return None
    centre = edge.mean(axis=0)
    normal = np.linalg.svd(edge - centre)[2][1]
    return np.array([*normal, -normal @ centre])


def _crossing(first: F64, second: F64) -> F64:
    point = np.cross(first, second)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing: F64 = point[:2] / point[2]
    return crossing
