# SPDX-License-Identifier: Apache-2.0
"""What measured depths of an image say of a place: something before it, there, or behind it."""

from typing import NamedTuple

import cv2
import numpy as np

from edge.changes.proof import Proof
from edge.geometry import se3
from edge.types import F32, F64, Bools, DepthSamples, Look, Mat4, Pinhole

_SIGMAS = 3.0
_LEAST_APART = 0.03  # of a depth: nearer to each other, two depths are of one thing
_NO_DEPTH = DepthSamples(
    np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty(0, np.float32)
)


class View(NamedTuple):
    """An image's sure depths; pixels are those of the ideal camera."""

    frame_index: int
    t_ns: int
    T_map_cam: Mat4
    pixels: F64  # (n, 2) where depths were measured
    depth_m: F64  # (n,)
    share: F64  # (n,) their deviation, as a share
    xyz: F64  # (n, 3) where that is in the map [m]
    proof: Proof | None = None  # what it says of the map's points, if that was asked

    @property
    def origin(self) -> F64:
        """The camera's place (3,) in the map [m]."""
        place: F64 = self.T_map_cam[:3, 3]
        return place


class Told(NamedTuple):
    """How many depths say what of a place."""

    before: int
    there: int
    behind: int


def make_view(look: Look, camera: Pinhole, sure_share: float) -> View:
    """The view with those of its depths whose deviation is a smaller share of them."""
    depth = look.depth or _NO_DEPTH
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (depth.sigma / depth.inverse_depth).astype(np.float64)
    sure = (depth.inverse_depth > 0.0) & (share < sure_share)
    pixels = depth.pixels[sure].astype(np.float64)
    depth_m = 1.0 / depth.inverse_depth[sure].astype(np.float64)
    xyz = places_of(pixels, depth_m, look.T_map_cam, camera)
    return View(look.index, look.t_ns, look.T_map_cam, pixels, depth_m, share[sure], xyz)


def places_of(pixels: F64, depth_m: F64, T_map_cam: Mat4, camera: Pinhole) -> F64:
    """Where depths (n,) at ideal pixels (n, 2) are (n, 3) in the map [m]."""
    rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    local = np.column_stack((rays, np.ones(len(rays)))) * depth_m[:, None]
    return se3.transform(T_map_cam, local)


def seen_at(T_map_cam: Mat4, xyz: F64, camera: Pinhole) -> tuple[F64, F64]:
    """Ideal pixels (n, 2) and depths (n,) of places of the map; NaN behind the camera."""
    local = se3.transform(se3.inverse(T_map_cam), xyz)
    depth = np.where(local[:, 2] > 1e-3, local[:, 2], np.nan)
    pixels = local[:, :2] / depth[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return pixels, depth


def hull_of(pixels: F64) -> F32:
    """Corners (m, 2) of the convex hull."""
    hull: F32 = cv2.convexHull(pixels.astype(np.float32)).reshape(-1, 2)
    return hull


def within(hull: F32, pixels: F64) -> Bools:
    """Which pixels (n, 2) a convex hull (m, 2) holds."""
    (left, top), (right, bottom) = hull.min(axis=0), hull.max(axis=0)
    u, v = pixels[:, 0], pixels[:, 1]
    inside: Bools = (u >= left) & (u <= right) & (v >= top) & (v <= bottom)
    rows = np.flatnonzero(inside)
    if len(hull) < 3 or len(rows) == 0:
        return inside
    to = np.concatenate((hull[1:], hull[:1])) - hull
    turn = to[:, 0] * (v[rows, None] - hull[:, 1]) - to[:, 1] * (u[rows, None] - hull[:, 0])
    inside[rows] = (turn >= 0.0).all(axis=1) | (turn <= 0.0).all(axis=1)
    return inside


def ask(view: View, hull: F32, near_m: float, far_m: float) -> Told:
    """What the depths within a hull say of a thing that reaches from `near_m` to `far_m`."""
    inside = within(hull, view.pixels)
    depth = view.depth_m[inside]
    slack = np.maximum(_SIGMAS * view.share[inside], _LEAST_APART)
    before = int((depth < near_m * (1.0 - slack)).sum())
    behind = int((depth > far_m * (1.0 + slack)).sum())
    return Told(before, len(depth) - before - behind, behind)
