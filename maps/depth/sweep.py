# SPDX-License-Identifier: Apache-2.0
"""A depth map of one image from its neighbours, without a right camera and without a GPU."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.image.pyramid import MASK_MARGIN_PX, half_size
from edge.odometry import kernels_select
from edge.types import F32, F64, I32, U8, Mat4, Pinhole
from maps.depth import kernels_multiview, kernels_sweep

MAX_FINE_PIXELS = 500_000  # larger images are halved first
_MAX_PLANES = 112
_MIN_PLANES = 32
_MAX_MARGIN = 0.25  # of the image's size: how far beyond it a neighbour is looked at
# Costs of a census bit are 4: one plane's step, and a jump of depth where the image is even.
_P1, _P2 = np.float32(12.0), np.float32(110.0)
_KEPT = 3  # of four neighbours: what one of them does not see does not count
_MIN_MARGIN = 1.02  # how much worse any other depth must be


class FineImage(NamedTuple):
    """An undistorted image at the size at which depths are measured."""

    pinhole: Pinhole
    grey: U8  # (h, w)
    valid: U8  # (h, w)
    halvings: int  # from full size


class DepthMap(NamedTuple):
    """What one view knows of depth before the others are asked."""

    pinhole: Pinhole  # of `pixels`
    pixels: I32  # (n, 2) u, v with a strong gradient, in the fine image
    rho: F32  # (n,) inverse depth, 0 where unknown
    sigma: F32  # (n,) its standard deviation
    support: U8  # (n,) neighbours that see the same there
    coarse: F32  # (h/2, w/2) inverse depth of every pixel, 0 where unknown


def fine_image(image: U8, camera: CameraModel) -> FineImage:
    """Undistort and halve a raw image."""
    valid = np.ones(image.shape, np.uint8)
    if camera.distortion_model != "none":
        map_x, map_y, valid = camera.undistortion_maps()
        image = cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR)
    pinhole, halvings = fine_pinhole(camera)
    for _ in range(halvings):
        image, valid = _halved(image), (_halved(255 * valid) == 255).astype(np.uint8)
    return FineImage(pinhole, image, valid, halvings)


def fine_pinhole(camera: CameraModel) -> tuple[Pinhole, int]:
    """Intrinsics of the fine image of a camera, and how often it is halved."""
    pinhole, halvings = camera.pinhole, 0
    while pinhole.width * pinhole.height > MAX_FINE_PIXELS:
        pinhole, halvings = half_size(pinhole), halvings + 1
    return pinhole, halvings


def gradient_pixels(fine: FineImage, config: OdometryConfig) -> I32:
    """Pixels (n, 2) that the odometry could choose in this image."""
    height, width = fine.grey.shape
    level = np.zeros((height, width, 3), np.float32)
    grey = fine.grey.astype(np.float32)
    level[..., 0] = grey
    level[:, 1:-1, 1] = 0.5 * (grey[:, 2:] - grey[:, :-2])
    level[1:-1, :, 2] = 0.5 * (grey[2:] - grey[:-2])
    mask = cv2.erode(fine.valid, np.ones((2 * MASK_MARGIN_PX + 1,) * 2, np.uint8))
    border = MASK_MARGIN_PX
    mask[:border], mask[-border:], mask[:, :border], mask[:, -border:] = 0, 0, 0, 0
    region = kernels_select.REGION_PX
    thresholds = np.zeros((-(-height // region), -(-width // region)), np.float32)
    kernels_select.region_thresholds(level, mask, 0.5, config.gradient_margin_grey, thresholds)
    limit = np.repeat(np.repeat(thresholds, region, 0), region, 1)[:height, :width]
    strong = (level[..., 1] ** 2 + level[..., 2] ** 2 > limit) & (mask > 0)
    v, u = np.nonzero(strong)
    return np.stack((u, v), axis=1).astype(np.int32)


def sweep(
    reference: FineImage,
    neighbours: list[FineImage],
    T_neighbour_ref: list[Mat4],
    rho_range: tuple[float, float],
    pixels: I32,
) -> DepthMap:
    """Depths of the reference by its neighbours.

    rho_range : nearest and farthest inverse depth, the smaller first
    pixels : (n, 2) where depths are wanted
    """
    rotated, shifts = derotated(reference, neighbours, T_neighbour_ref, rho_range[1])
    rho = _planes(reference.pinhole, shifts, rho_range)
    coarse = _coarse_depth(reference, rotated, shifts, rho)
    v, u = (pixels[:, 1] // 2, pixels[:, 0] // 2)
    height, width = coarse.shape
    start = coarse[np.minimum(v, height - 1), np.minimum(u, width - 1)]
    n = len(pixels)
    rho_found, sigma, cost = np.zeros((3, n), np.float32)
    support: U8 = np.zeros(n, np.uint8)
    stack = np.stack([grey for grey, _ in rotated]).astype(np.float32)
    valid = np.stack([mask for _, mask in rotated])
    kernels_multiview.refine(
        reference.grey.astype(np.float32), stack, valid, shifts, pixels, start,
        np.float32(rho[1] - rho[0]), rho_found, sigma, cost, support,
    )  # fmt: skip
    return DepthMap(reference.pinhole, pixels, rho_found, sigma, support, coarse)


def derotated(
    reference: FineImage, neighbours: list[FineImage], T_neighbour_ref: list[Mat4], rho_max: float
) -> tuple[list[tuple[U8, U8]], F32]:
    """Neighbours as cameras with the reference's axes see them, and how they are shifted.

    Returns grey and valid images (h2, w2) of each, with margins around the reference's size, and
    the rows (7,) that the kernels take: fx tx, fy ty, tz, cx, cy, and the margins.
    """
    pinhole = reference.pinhole
    shifts = np.zeros((len(neighbours), 7), np.float32)
    for row, T in zip(shifts, T_neighbour_ref, strict=True):
        t = -se3.inverse(T)[:3, 3]  # of the reference's points to the neighbour's place
        row[:5] = pinhole.fx * t[0], pinhole.fy * t[1], t[2], pinhole.cx, pinhole.cy
    limits = _MAX_MARGIN * np.array([pinhole.width, pinhole.height])
    reach = np.abs(shifts[:, :2]).max(axis=0) * rho_max
    margins = 2 * np.ceil(0.5 * np.minimum(reach, limits)).astype(int) + 8
    shifts[:, 5:] = margins
    rotated = []
    for other, T in zip(neighbours, T_neighbour_ref, strict=True):
        rotated.append(_turned(other, T[:3, :3], pinhole, margins))
    return rotated, shifts


def _turned(other: FineImage, R: F64, pinhole: Pinhole, margins: I32) -> tuple[U8, U8]:
    K, K_other = _matrix(pinhole), _matrix(other.pinhole)
    back = np.linalg.inv(K) @ np.array([[1, 0, -margins[0]], [0, 1, -margins[1]], [0, 0, 1.0]])
    H = K_other @ R @ back
    size = (pinhole.width + 2 * int(margins[0]), pinhole.height + 2 * int(margins[1]))
    # Even, so that half of it is exact.
    size = (size[0] // 2 * 2, size[1] // 2 * 2)
    how = cv2.WARP_INVERSE_MAP
    grey = cv2.warpPerspective(other.grey, H, size, flags=cv2.INTER_LINEAR | how)
    mask = cv2.warpPerspective(other.valid, H, size, flags=cv2.INTER_NEAREST | how)
    ahead = H[2, 0] * np.arange(size[0])[None] + (H[2, 1] * np.arange(size[1]) + H[2, 2])[:, None]
    mask[ahead < 0.1 * H[2, 2]] = 0
    return grey, mask


def _planes(pinhole: Pinhole, shifts: F32, rho_range: tuple[float, float]) -> F32:
    """Inverse depths a coarse pixel apart in the neighbour that moves most."""
    low, high = rho_range
    corners = np.array([[0, 0], [pinhole.width, 0], [0, pinhole.height], [pinhole.width] * 2])
    corners = corners - (pinhole.cx, pinhole.cy)
    speed = np.hypot(
        shifts[:, 0] - corners[:, :1] * shifts[:, 2], shifts[:, 1] - corners[:, 1:] * shifts[:, 2]
    )
    steps = int(np.ceil(0.5 * speed.max() * (high - low)))
    rho: F32 = np.linspace(low, high, np.clip(steps, _MIN_PLANES, _MAX_PLANES)).astype(np.float32)
    return rho


def _coarse_depth(reference: FineImage, rotated: list[tuple[U8, U8]], shifts: F32, rho: F32) -> F32:
    grey = _halved(reference.grey).astype(np.float32)
    valid = _shrunk(_halved(255 * reference.valid))
    codes, others, others_valid = _codes(grey), [], []
    for other, mask in rotated:
        others.append(_codes(_halved(other).astype(np.float32)))
        others_valid.append(_shrunk(_halved(255 * mask)))
    half = shifts.copy()
    half[:, :2] /= 2.0
    half[:, 3:5] = (half[:, 3:5] + 0.5) / 2.0 - 0.5
    half[:, 5:] /= 2.0
    height, width = grey.shape
    n, planes = len(rotated), len(rho)
    cost = np.empty((height, width, planes), np.uint8)
    kernels_sweep.sweep(
        codes, valid, np.stack(others), np.stack(others_valid), half, rho, min(_KEPT, n),
        np.empty((planes, width), np.uint8), np.empty((n, width), np.float32), cost,
    )  # fmt: skip
    total = np.empty((height, width, planes), np.float32)
    paths = np.empty((2, 3, width + 2, planes + 3), np.float32)
    kernels_sweep.aggregate(cost, grey, _P1, _P2, paths, total)
    coarse, margin = np.empty((2, height, width), np.float32)
    kernels_sweep.choose(total, cost, rho, coarse, margin)
    coarse[margin < _MIN_MARGIN] = 0.0
    return coarse


def _codes(grey: F32) -> NDArray[np.uint64]:
    codes: NDArray[np.uint64] = np.empty(grey.shape, np.uint64)
    kernels_sweep.census(grey, codes)
    return codes


def _halved(image: U8) -> U8:
    height, width = image.shape[0] // 2, image.shape[1] // 2
    smaller: U8 = cv2.resize(
        image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA
    )
    return smaller


def _shrunk(mask: U8) -> U8:
    """Where the whole census lies in the image."""
    valid = (mask == 255).astype(np.uint8)
    eroded: U8 = cv2.erode(valid, np.ones((7, 7), np.uint8))
    eroded[:3], eroded[-3:], eroded[:, :3], eroded[:, -3:] = 0, 0, 0, 0
    return eroded


def _matrix(pinhole: Pinhole) -> F64:
    return np.array([[pinhole.fx, 0.0, pinhole.cx], [0.0, pinhole.fy, pinhole.cy], [0.0, 0.0, 1.0]])
