# SPDX-License-Identifier: Apache-2.0
"""Depths of features and of well-spread pixels, from a depth image."""

import cv2
import numpy as np

from edge.geometry.camera import CameraModel
from edge.types import F32, F64, U8, DepthSamples

# A depth image in millimetres rounds by 0.3 mm; a sensor is off by about 0.3 % of the range.
_ROUNDING_M = 0.0005
_RELATIVE = 0.003
# Wider spread around a pixel means an edge between two surfaces: which one is the corner's?
_MAX_SPREAD = 0.05


def depth_at(depth: F32, pixels: F32, octave: U8) -> tuple[F64, F64]:
    """Depth (n,) and standard deviation (n,) at raw pixels (n, 2); 0 where it is not known.

    Of the 3x3 pixels around (5x5 at the coarse octaves) all must be known and lie together; their
    spread is part of the uncertainty, as the corner may be a pixel off.
    """
    values, sigma = np.zeros(len(pixels)), np.zeros(len(pixels))
    for reach, chosen in ((1, octave < 4), (2, octave >= 4)):
        rows = np.flatnonzero(chosen)
        u, v = np.round(pixels[rows]).astype(int).T
        height, width = depth.shape
        inside = (u >= reach) & (v >= reach) & (u < width - reach) & (v < height - reach)
        rows, u, v = rows[inside], u[inside], v[inside]
        dv, du = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
        patch = depth[v[:, None] + dv, u[:, None] + du].astype(np.float64)
        middle = np.median(patch, axis=1)
        spread = patch.max(axis=1) - patch.min(axis=1)
        good = (patch.min(axis=1) > 0.0) & (spread <= _MAX_SPREAD * middle)
        values[rows[good]] = middle[good]
        # Half the range over the patch is what one pixel off makes.
        local = _ROUNDING_M + 0.5 * spread[good] / reach
        sigma[rows[good]] = np.hypot(local, _RELATIVE * middle[good])
    return values, sigma


def depth_samples(image: U8, depth: F32, camera: CameraModel, count: int) -> DepthSamples:
    """At most `count` depths at the strongest gradients, one for each cell of a grid."""
    if count == 0:
        return DepthSamples(*(np.empty(shape, np.float32) for shape in ((0, 2), 0, 0)))
    height, width = image.shape
    cell = max(4, int(np.ceil(np.sqrt(height * width / count))))
    smooth = cv2.GaussianBlur(image, (3, 3), 0).astype(np.float32)
    gradient = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    gradient[:2], gradient[-2:], gradient[:, :2], gradient[:, -2:] = 0.0, 0.0, 0.0, 0.0
    flat = _is_smooth(depth)
    gradient[~flat] = 0.0
    rows, columns = height // cell, width // cell
    cells = gradient[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    cells = cells.transpose(0, 2, 1, 3).reshape(rows * columns, cell * cell)
    best = np.argmax(cells, axis=1)
    strong = np.flatnonzero(cells[np.arange(len(best)), best] > 0.0)
    v = strong // columns * cell + best[strong] // cell
    u = strong % columns * cell + best[strong] % cell
    raw = np.stack((u, v), axis=1).astype(np.float32)
    ideal = camera.undistort_pixels(raw).astype(np.float32)
    values, sigma = depth_at(depth, raw, np.zeros(len(raw), np.uint8))
    keep = np.isfinite(ideal).all(axis=1) & (values > 0.0)
    inverse = 1.0 / values[keep]
    return DepthSamples(
        ideal[keep], inverse.astype(np.float32), (sigma[keep] * inverse**2).astype(np.float32)
    )


def _is_smooth(depth: F32) -> U8:
    """(h, w) bool, where the 3x3 depths are known and lie together."""
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(depth, kernel), cv2.dilate(depth, kernel)
    smooth: U8 = (low > 0.0) & (high - low <= _MAX_SPREAD * depth)
    return smooth
