# SPDX-License-Identifier: Apache-2.0
"""What measured depths of an image say of a place: something before it, there, or behind it."""

from typing import NamedTuple

import cv2
import numpy as np

from edge.changes.proof import CONFIRMED, Proof
from edge.geometry import se3
from edge.types import F32, F64, I32, Bools, DepthSamples, Look, Mat4, Pinhole

_SIGMAS = 3.0
_LEAST_APART = 0.03  # of a depth: nearer to each other, two depths are of one thing
_SURE = 0.06  # deviation of a depth, as a share of it
_NO_DEPTH = DepthSamples(
    np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty(0, np.float32)
)


class View(NamedTuple):
    """An image with its depths; pixels are those of the ideal camera."""

    number: int  # of all views, in their order
    frame_index: int
    t_ns: int
    T_map_cam: Mat4
    pixels: F64  # (n, 2) where depths were measured
    depth_m: F64  # (n,)
    share: F64  # (n,) their deviation, as a share
    points: I32  # (m,) of the map that it should show
    point_pixels: F64  # (m, 2)
    point_depth_m: F64  # (m,)
    verdict: I32  # (m,) as in Proof
    control: float  # share of the points that the image confirms

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


def make_view(number: int, look: Look, proof: Proof, camera: Pinhole) -> View:
    """The view with those of its depths that are sure."""
    depth = look.depth or _NO_DEPTH
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (depth.sigma / depth.inverse_depth).astype(np.float64)
    sure = (depth.inverse_depth > 0.0) & (share < _SURE)
    inverse = depth.inverse_depth[sure].astype(np.float64)
    T_cam_map = se3.inverse(look.T_map_cam)
    local = se3.transform(T_cam_map, proof.xyz)
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    return View(
        number=number,
        frame_index=look.index,
        t_ns=look.t_ns,
        T_map_cam=look.T_map_cam,
        pixels=depth.pixels[sure].astype(np.float64),
        depth_m=1.0 / inverse,
        share=share[sure],
        points=proof.points,
        point_pixels=local[:, :2] / local[:, 2:] * focal + middle,
        point_depth_m=local[:, 2],
        verdict=proof.verdict,
        control=float((proof.verdict == CONFIRMED).mean()) if len(proof.verdict) else 0.0,
    )


def points_of(view: View, camera: Pinhole) -> F64:
    """Where the depths of a view are (n, 3) in the map [m]."""
    rays = (view.pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    local = np.column_stack((rays, np.ones(len(rays)))) * view.depth_m[:, None]
    return se3.transform(view.T_map_cam, local)


def slack_of(share: F64) -> F64:
    """How far (n,) from a depth, as a share of it, another one is of another thing."""
    return np.maximum(_SIGMAS * share, _LEAST_APART)


def seen_at(view: View, points: F64, camera: Pinhole) -> tuple[F64, F64]:
    """Ideal pixels (n, 2) and depths (n,) of points of the map; NaN behind the camera."""
    local = se3.transform(se3.inverse(view.T_map_cam), points)
    depth = np.where(local[:, 2] > 1e-6, local[:, 2], np.nan)
    pixels = local[:, :2] / depth[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return pixels, depth


def hull_of(pixels: F64, grown_px: float = 0.0) -> F32:
    """Corners (m, 2) of the convex hull, each moved away from the middle."""
    hull = cv2.convexHull(pixels.astype(np.float32)).reshape(-1, 2)
    away = hull - hull.mean(axis=0)
    length = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
    grown: F32 = (hull + away / length * grown_px).astype(np.float32)
    return grown


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
    depth, slack = view.depth_m[inside], slack_of(view.share[inside])
    before = int((depth < near_m * (1.0 - slack)).sum())
    behind = int((depth > far_m * (1.0 + slack)).sum())
    return Told(before, len(depth) - before - behind, behind)
