# SPDX-License-Identifier: Apache-2.0
"""Line segments of an image: found at half size, joined, and measured at full size."""

import cv2
import numpy as np

from edge.config.lines import SegmentConfig
from edge.lines import kernels_segments
from edge.lines.line import Segments, segments_between
from edge.types import F64, U8

# Found segments are shorter than their edge by what is lost where its ends are round.
_SHORTEST_PIECE = 0.4


class SegmentDetector:
    """Finds the segments of one image after another.

    OpenCV's line segment detector (von Gioi et al. 2010) runs at half size, where it costs a
    quarter, and finds regions only; places and directions come from the full-size image. Owned
    by one thread.
    """

    def __init__(self, config: SegmentConfig, *, halve: bool = True) -> None:
        """`halve=False` is for images that are small already."""
        self._config, self._halve = config, halve
        self._detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_NONE)

    def detect(self, image: U8, valid: U8 | None = None) -> Segments:
        """Segments of an image (h, w) without lens distortion, longest first.

        valid : (h, w), 0 where the image shows nothing, as at the borders of undistorted ones;
            segments that touch such places are left out.
        """
        config = self._config
        ends = self._pieces(image)
        alive = np.empty(len(ends), np.uint8)
        cosine = float(np.cos(np.deg2rad(config.merge_angle_deg)))
        kernels_segments.join(ends, config.merge_across_px, cosine, config.merge_gap_share, alive)
        ends = _longest(ends[alive > 0], config.min_length_px)[: 2 * config.max_segments]
        sigma = np.empty(len(ends))
        kernels_segments.measure(image, ends, config.min_contrast_grey, sigma)
        good = np.isfinite(sigma)
        if valid is not None:
            good &= _is_valid(ends, valid)
        length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
        chosen = np.flatnonzero(good & (length >= config.min_length_px))
        chosen = chosen[np.argsort(-length[chosen], kind="stable")][: config.max_segments]
        return segments_between(ends[chosen], np.hypot(sigma[chosen], config.floor_px))

    def _pieces(self, image: U8) -> F64:
        """Ends (n, 4) in full-size pixels, longest first, brighter side always on one hand."""
        if not self._halve:
            return _longest(self._found(image), _SHORTEST_PIECE * self._config.min_length_px)
        height, width = image.shape
        # An odd row or column is left out: two pixels make one, and none is stretched.
        even = np.ascontiguousarray(image[: height // 2 * 2, : width // 2 * 2])
        half = cv2.resize(even, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        ends = 2.0 * self._found(half) + 0.5  # pixel centres move
        return _longest(ends, _SHORTEST_PIECE * self._config.min_length_px)

    def _found(self, image: U8) -> F64:
        """Ends (n, 4) of what OpenCV finds."""
        found = self._detector.detect(image)[0]
        if found is None:
            return np.empty((0, 4))
        # OpenCV 4 gives (n, 1, 4), OpenCV 5 (n, 4).
        return np.asarray(found, np.float64).reshape(-1, 4)


def _longest(ends: F64, at_least: float) -> F64:
    """Those of some length, longest first; the order of equal ones stays."""
    length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
    order = np.argsort(-length, kind="stable")
    return np.ascontiguousarray(ends[order[: np.count_nonzero(length >= at_least)]])


def _is_valid(ends: F64, valid: U8) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    good = np.ones(len(ends), np.bool_)
    limit = np.array(valid.shape[::-1]) - 1
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        place = (1.0 - share) * ends[:, :2] + share * ends[:, 2:]
        u, v = np.clip(np.rint(place), 0, limit).astype(np.int32).T
        good &= valid[v, u] > 0
    return good
