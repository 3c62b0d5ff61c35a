# SPDX-License-Identifier: Apache-2.0
"""A video with poses and surfaces, into which things that were cut out are painted."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from edge.cameras.recording import open_recording
from edge.geometry import se3
from edge.tiles.reader import NO_POINT, Map, open_map
from edge.types import F64, U8, Bools, Mat4, Pinhole

PLANE_M = 0.012  # depths so near to a plane are on it
CELL_M = 0.02  # of the level surface
_LEVEL_DEG, _PLANES = 40.0, 4000
_GAP_M = 0.25  # without depths, on what is plain
_OVERHANG_M = 0.08  # what else is so narrow at that height is no part of it
_TALL_M = 0.5
_STANDS_M = 0.03
_CELL_PX, _HIDING, _NEARER = 8, 3, 0.95  # so many depths of a cell, nearer by so much, hide


class Cutout(NamedTuple):
    """A thing as one image shows it; of what lies flat, as it is seen from above."""

    label: str
    bgr: U8  # (h, w, 3)
    alpha: U8  # (h, w), 255 inside
    foot_px: F64  # (2,) the middle of its lower end; of what lies flat, its middle
    up_px: F64  # (2,) unit, where up is in this image
    m_per_px: float
    is_flat: bool = False


class Stand(NamedTuple):
    """A thing and where it stands, or lies."""

    thing: Cutout
    foot: F64  # (3,) [m]
    up: F64  # (3,) unit
    turn_rad: float = 0.0  # of what lies flat

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height."""
        h, w = self.thing.alpha.shape
        return w * self.thing.m_per_px, h * self.thing.m_per_px

    @property
    def reach_m(self) -> float:
        """Of its foot, half of what it takes of the ground."""
        w, h = self.size_m
        return 0.5 * float(np.hypot(w, h)) if self.thing.is_flat else 0.5 * w

    @property
    def center(self) -> F64:
        """Its middle (3,) [m]."""
        high = 0.0 if self.thing.is_flat else 0.5 * self.size_m[1]
        middle: F64 = self.foot + high * self.up
        return middle


class Scene:
    """A video with poses, and the surfaces in it."""

    def __init__(self, video: Path, depths: Path) -> None:
        """`depths` is a map of the video with depth samples."""
        self.recording = open_recording(video)
        self.camera: Pinhole = self.recording.camera.pinhole
        truth = self.recording.groundtruth
        assert truth is not None
        at = np.abs(self.recording.t_ns[:, None] - truth.t_ns[None]).argmin(axis=1)
        self.poses = truth.T_world_cam[at]
        self.xyz = _surface(open_map(depths))
        self.up, on_it = _level(self.xyz, -self.poses[:, :3, 1].mean(axis=0))
        self.axes: F64 = np.linalg.svd(self.up[None])[2][1:]  # (2, 3) of the ground
        self._height = float((on_it @ self.up).mean())
        self.ground = self._free_ground(on_it)

    def paint(self, bgr: U8, i: int, stand: Stand) -> tuple[U8, Bools]:
        """Image `i` with a thing in it, and which pixels (h, w) show it."""
        warp = self._warp(i, stand)
        h, w = bgr.shape[:2]
        if warp is None:
            return bgr, np.zeros((h, w), bool)
        thing = cv2.warpPerspective(stand.thing.bgr, warp, (w, h), borderMode=cv2.BORDER_REPLICATE)
        alpha = cv2.warpPerspective(stand.thing.alpha, warp, (w, h))
        alpha[self._hidden(i, stand, (h, w))] = 0
        share = cv2.GaussianBlur(alpha, (3, 3), 0)[:, :, None].astype(np.float32) / 255.0
        mixed: U8 = np.rint(share * thing + (1.0 - share) * bgr).astype(np.uint8)
        return mixed, alpha > 127

    def pixels_at(self, i: int, xyz: F64) -> tuple[F64, F64]:
        """Pixels (n, 2) and depths (n,) in image `i`."""
        return project(self.camera, self.poses[i], xyz)

    def on_ground(self, uv: F64) -> F64:
        """Places (n, 3) of the ground, given along its axes (n, 2)."""
        places: F64 = uv @ self.axes + self._height * self.up
        return places

    def ground_in(self, i: int) -> F64:
        """Takes (u, v, 1) on the ground to homogeneous pixels of image `i`: (3, 3)."""
        T_cam_world = se3.inverse(self.poses[i])
        columns = np.column_stack([*self.axes, self._height * self.up])
        local = T_cam_world[:3, :3] @ columns
        local[:, 2] += T_cam_world[:3, 3]
        K = np.array(
            [
                [self.camera.fx, 0.0, self.camera.cx],
                [0.0, self.camera.fy, self.camera.cy],
                [0.0, 0.0, 1.0],
            ]
        )
        warp: F64 = K @ local
        return warp

    def _free_ground(self, on_it: F64) -> F64:
        """Middles (n, 2) of cells of the level surface on which nothing stands."""
        above = self.xyz @ self.up - self._height
        standing = self.xyz[(above > _STANDS_M) & (above < _TALL_M)] @ self.axes.T
        uv = on_it @ self.axes.T
        low = uv.min(axis=0)
        shape = tuple(np.ceil((uv.max(axis=0) - low) / CELL_M).astype(int) + 1)
        cells, taken = _count(uv, low, shape) > 0, _count(standing, low, shape) > 1
        grown = _morph(cells, cv2.MORPH_CLOSE, _GAP_M)
        grown = _morph(grown & ~taken, cv2.MORPH_OPEN, _OVERHANG_M)
        _, parts, stats, _ = cv2.connectedComponentsWithStats(grown.astype(np.uint8))
        largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
        free: F64 = low + (np.argwhere(parts == largest) + 0.5) * CELL_M
        return free

    def _warp(self, i: int, stand: Stand) -> F64 | None:
        """From the cutout's pixels to those of image `i` (3, 3)."""
        thing = stand.thing
        if thing.is_flat:
            cos, sin = np.cos(stand.turn_rad), np.sin(stand.turn_rad)
            turn = thing.m_per_px * np.array([[cos, -sin], [sin, cos]])
            laid = np.eye(3)
            laid[:2] = np.column_stack([turn, stand.foot @ self.axes.T - turn @ thing.foot_px])
            if self.pixels_at(i, stand.foot[None])[1][0] - stand.reach_m < 0.3:
                return None
            return self.ground_in(i) @ laid
        high = stand.size_m[1]
        # About its middle: about its foot, what a camera sees from above would stand farther off.
        places = stand.foot + np.array([[0.0], [0.5 * high], [high]]) * stand.up
        pixels, depth = self.pixels_at(i, places)
        if depth.min() < 0.3:
            return None
        up = (pixels[2] - pixels[0]) / np.linalg.norm(pixels[2] - pixels[0])
        scale = thing.m_per_px * self.camera.fx / depth[1]
        old = thing.up_px
        cos, sin = float(old @ up), float(old[0] * up[1] - old[1] * up[0])
        turn = scale * np.array([[cos, -sin], [sin, cos]])
        upright = np.eye(3)
        middle = thing.foot_px + 0.5 * high / thing.m_per_px * old
        upright[:2] = np.column_stack([turn, pixels[1] - turn @ middle])
        return upright

    def _hidden(self, i: int, stand: Stand, shape: tuple[int, int]) -> Bools:
        pixels, depth = self.pixels_at(i, self.xyz)
        own = self.pixels_at(i, stand.foot[None])[1][0] - stand.reach_m
        near = (depth > 0.2) & (depth < _NEARER * own)
        near &= ((pixels >= 0) & (pixels < (shape[1], shape[0]))).all(axis=1)
        cells = np.zeros((shape[0] // _CELL_PX + 1, shape[1] // _CELL_PX + 1), np.int32)
        at = (pixels[near] / _CELL_PX).astype(np.int64)
        np.add.at(cells, (at[:, 1], at[:, 0]), 1)
        hidden = np.kron(cells >= _HIDING, np.ones((_CELL_PX, _CELL_PX), bool))
        return np.asarray(hidden[: shape[0], : shape[1]], bool)


def project(camera: Pinhole, T_world_cam: Mat4, xyz: F64) -> tuple[F64, F64]:
    """Pixels (n, 2) and depths (n,) of points; where they lie behind, the depth says so."""
    local = se3.transform(se3.inverse(T_world_cam), xyz)
    safe = np.where(np.abs(local[:, 2:]) > 1e-6, local[:, 2:], 1e-6)
    pixels: F64 = local[:, :2] / safe * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return pixels, local[:, 2]


def _count(uv: F64, low: F64, shape: tuple[int, ...]) -> F64:
    """How many places (n, 2) lie in each cell."""
    at = np.floor((uv - low) / CELL_M).astype(int)
    at = at[((at >= 0) & (at < shape)).all(axis=1)]
    counts = np.zeros(shape)
    np.add.at(counts, (at[:, 0], at[:, 1]), 1.0)
    return counts


def _morph(cells: Bools, operation: int, size_m: float) -> Bools:
    side = round(size_m / CELL_M) | 1
    kernel = np.ones((side, side), np.uint8)
    grown: Bools = cv2.morphologyEx(cells.astype(np.uint8), operation, kernel) > 0
    return grown


def _surface(map_: Map) -> F64:
    parts = []
    for k in range(map_.n_keyframes):
        samples, features = map_.depth_samples(k), map_.features(k)
        camera = map_.cameras[int(map_.keyframe_camera[k])].pinhole
        rays = (samples.pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        depth = 1.0 / samples.inverse_depth.astype(np.float64)[:, None]
        local = np.column_stack([rays, np.ones(len(rays))]) * depth
        parts.append(se3.transform(map_.pose(k), local))
        parts.append(map_.points(features.point[features.point != NO_POINT]).xyz)
    return np.concatenate(parts)


def _level(xyz: F64, up: F64) -> tuple[F64, F64]:
    """Upward normal (3,) of the largest level surface, and the points (n, 3) on it."""
    rng = np.random.default_rng(5)
    up = up / np.linalg.norm(up)
    some = xyz[rng.permutation(len(xyz))[:5_000]]
    best, normal, offset = 0, up, 0.0
    for _ in range(_PLANES):
        a, b, c = some[rng.integers(len(some), size=3)]
        n = np.cross(b - a, c - a)
        if np.linalg.norm(n) < 1e-4:
            continue
        n = n / np.linalg.norm(n)
        n = n if n @ up > 0.0 else -n
        on = int((np.abs((some - a) @ n) < PLANE_M).sum())
        if on > best and n @ up > np.cos(np.radians(_LEVEL_DEG)):
            best, normal, offset = on, n, float(n @ a)
    for _ in range(3):
        on_it = xyz[np.abs(xyz @ normal - offset) < PLANE_M]
        middle = on_it.mean(axis=0)
        n = np.linalg.svd((on_it - middle)[:: max(1, len(on_it) // 5000)], full_matrices=False)[2][
            2
        ]
        normal = n if n @ up > 0.0 else -n
        offset = float(normal @ middle)
    return normal, xyz[np.abs(xyz @ normal - offset) < PLANE_M]
