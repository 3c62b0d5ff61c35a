# SPDX-License-Identifier: Apache-2.0
"""Whether given poses fit their images: neighbours are matched without them, and asked.

Poses from world to camera, with the axes of another convention, a quaternion that begins with w or
the stamps of another clock are no error that a file shows, and chance matches along wrong epipolar
lines make a map all the same. In 19 builds of ten recordings poses allowed 78 % of such matches or
more; after each of those mistakes, in two recordings, 2 to 48 %.
"""

import logging
from typing import NamedTuple

import cv2
import numpy as np

from edge.geometry import se3, so3
from edge.types import F64, Mat4
from maps.describe import Description
from maps.settings import BuildSettings
from maps.views import ViewSet

log = logging.getLogger(__name__)

_MAX_RATIO = 0.8  # of the best match's distance to the next (Lowe 2004)
_MOST_PAIRS = 24
_LEAST_PAIRS = 3
_LEAST_MATCHES = 30  # of a pair whose images agree between them how the camera moved
_LEAST_SHARE = 0.5  # of those, to lie where the poses say


class _Matched(NamedTuple):
    """Corners that two images share by their looks alone."""

    first: F64  # (n, 3) rays, z = 1
    second: F64


def warn_of_wrong_poses(
    chosen: ViewSet, descriptions: list[Description], settings: BuildSettings
) -> None:
    """Say where most corners that neighbours share do not lie where the poses say."""
    share = fitting_share(chosen, descriptions, settings.epipolar_px)
    if share is not None and share < _LEAST_SHARE:
        log.warning(
            "the poses do not fit the images: of the corners that neighbours share %.0f %% lie "
            "where the poses say. Are they camera to world, x right, y down, z forward, qw last, "
            "and of the images' times? --poses sfm finds others",
            100.0 * share,
        )


def fitting_share(
    chosen: ViewSet, descriptions: list[Description], epipolar_px: float
) -> float | None:
    """Share of matches of neighbours that their poses allow, in the median; None if unknown.

    Asked are neighbours whose images say by themselves how the camera moved, and only the matches
    that agree on that.
    """
    views = chosen.views
    shares = []
    n_pairs = min(len(views) - 1, _MOST_PAIRS)
    for i in np.linspace(0, len(views) - 2, n_pairs).round().astype(int).tolist():
        matched = _matched(chosen, descriptions, i)
        focal = chosen.cameras[views[i].camera].fx
        T_second_first = se3.inverse(views[i + 1].T_map_cam) @ views[i].T_map_cam
        agreeing = _agreeing(matched, epipolar_px / focal)
        if len(agreeing.first) >= _LEAST_MATCHES:
            off_px = focal * _off_line(agreeing, T_second_first)
            shares.append(float(np.mean(off_px < epipolar_px)))
    return float(np.median(shares)) if len(shares) >= _LEAST_PAIRS else None


def _matched(chosen: ViewSet, descriptions: list[Description], i: int) -> _Matched:
    """Clear matches of view `i` with the next."""
    a, b = (descriptions[k].features for k in (i, i + 1))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a.descriptors, b.descriptors, k=2)
    clear = [
        (pair[0].queryIdx, pair[0].trainIdx)
        for pair in pairs
        if len(pair) == 2 and pair[0].distance < _MAX_RATIO * pair[1].distance
    ]
    rows = np.array(clear, int).reshape(-1, 2)
    sides = []
    for k, pixels in ((i, a.pixels[rows[:, 0]]), (i + 1, b.pixels[rows[:, 1]])):
        pinhole = chosen.cameras[chosen.views[k].camera].pinhole
        normalised = (pixels - (pinhole.cx, pinhole.cy)) / (pinhole.fx, pinhole.fy)
        sides.append(np.column_stack((normalised, np.ones(len(rows)))))
    return _Matched(*sides)


def _agreeing(matched: _Matched, tolerance: float) -> _Matched:
    """The matches that one motion of the camera explains."""
    if len(matched.first) < _LEAST_MATCHES:
        return matched
    _, mask = cv2.findEssentialMat(
        matched.first[:, :2], matched.second[:, :2], np.eye(3), cv2.RANSAC, 0.999, tolerance
    )
    inside = np.zeros(len(matched.first), bool) if mask is None else mask.ravel().astype(bool)
    return _Matched(matched.first[inside], matched.second[inside])


def _off_line(matched: _Matched, T_second_first: Mat4) -> F64:
    """Distance (n,) of the second's corners from the epipolar lines of the first's, z = 1."""
    t = T_second_first[:3, 3]
    line = matched.first @ (so3.hat(t) @ T_second_first[:3, :3]).T
    off: F64 = np.abs(np.einsum("ni,ni->n", matched.second, line))
    # A camera that stays where it is has no line, and whatever it sees fits.
    return off / np.maximum(np.hypot(line[:, 0], line[:, 1]), 1e-300)
