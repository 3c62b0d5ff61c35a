# SPDX-License-Identifier: Apache-2.0
"""A room's corner of which everything is known: grey is a smooth function of the point.

Seen from inside it has no occlusions, so every image is exact at every pixel.
"""

import numpy as np

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.image import kernels
from edge.types import F32, F64, U8, Frame, Mat4, Pinhole

SMALL = CameraModel(160, 120, 130.0, 132.0, 79.0, 60.5)
MIDDLE = CameraModel(240, 180, 200.0, 200.0, 119.5, 89.5)
MEDIUM = CameraModel(320, 240, 262.0, 262.0, 159.5, 119.5)
FRAME_NS = 33_333_333
# Walls n x + d >= 0 that hold the camera, which stands near the origin and looks along z.
_NORMALS = np.array([[0.1, 0, -1], [0, -1, -0.1], [-1, 0, -0.25], [1, 0, -0.15], [0, 1, -0.2]])
_OFFSETS = np.array([3.0, 0.9, 1.5, 1.6, 1.4])


class Corner:
    """Walls with waves of `wavelengths_m` on them; one image is (h, w) float64 grey."""

    def __init__(
        self,
        seed: int = 0,
        *,
        mean_grey: float = 110.0,
        contrast_grey: float = 30.0,
        wavelengths_m: tuple[float, float] = (0.12, 1.2),
    ) -> None:
        rng = np.random.default_rng(seed)
        n = 16
        directions = rng.normal(size=(n, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        shortest, longest = np.log(wavelengths_m)
        lengths = np.exp(np.linspace(shortest, longest, n))
        self._k = 2.0 * np.pi * directions / lengths[:, None]
        self._phase = rng.uniform(0.0, 2.0 * np.pi, n)
        self._mean, self._amplitude = mean_grey, contrast_grey * np.sqrt(2.0 / n)

    def grey_at(self, points: F64) -> F64:
        """Grey values (...) of points (..., 3) in the world."""
        waves = np.sin((points @ self._k.T + self._phase).astype(np.float32))
        return self._mean + self._amplitude * waves.sum(axis=-1, dtype=np.float64)

    def depth(self, camera: Pinhole | CameraModel, T_world_cam: Mat4) -> F64:
        """Depth along z (h, w) of every pixel."""
        v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
        return self.depth_at(camera, T_world_cam, u, v)

    def depth_at(self, camera: Pinhole | CameraModel, T_world_cam: Mat4, u: F64, v: F64) -> F64:
        """Depth along z of ideal pixels u, v of any one shape."""
        rays = _rays(camera, u, v) @ T_world_cam[:3, :3].T
        gap = _NORMALS @ T_world_cam[:3, 3] + _OFFSETS
        assert np.all(gap > 0.0), "the camera left the room"
        closing = -rays @ _NORMALS.T
        with np.errstate(divide="ignore"):
            return np.where(closing > 0.0, gap / closing, np.inf).min(axis=-1)

    def distance_to_walls(self, points: F64) -> F64:
        """How far points (n, 3) are from the nearest wall, negative outside the room."""
        lengths = np.linalg.norm(_NORMALS, axis=1)
        return ((points @ _NORMALS.T + _OFFSETS) / lengths).min(axis=1)

    def image(self, camera: Pinhole | CameraModel, T_world_cam: Mat4) -> F64:
        """Grey image (h, w) as an ideal pinhole sees it."""
        v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
        return self.image_at(camera, T_world_cam, u, v)

    def image_at(self, camera: Pinhole | CameraModel, T_world_cam: Mat4, u: F64, v: F64) -> F64:
        """Grey at ideal pixels u, v of any one shape."""
        depth = self.depth_at(camera, T_world_cam, u, v)
        points = _rays(camera, u, v) * depth[..., None]
        return self.grey_at(points @ T_world_cam[:3, :3].T + T_world_cam[:3, 3])


def _rays(camera: Pinhole | CameraModel, u: F64, v: F64) -> F64:
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return np.stack((x, y, np.ones_like(x)), axis=-1)


def to_bytes(grey: F64, noise_grey: float = 0.0, seed: int = 0) -> U8:
    """Grey values as a camera gives them."""
    if noise_grey > 0.0:
        grey = grey + np.random.default_rng(seed).normal(0.0, noise_grey, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def level_of(grey: F64) -> F32:
    """Level image (h, w, 3) of unrounded grey values."""
    level = np.zeros((*grey.shape, 3), np.float32)
    level[..., 0] = grey
    kernels.differentiate(level)
    return level


def frame_of(
    corner: Corner, camera: CameraModel, T_world_cam: Mat4, index: int, noise_grey: float = 1.0
) -> Frame:
    """One frame with noise of its own."""
    image = to_bytes(corner.image(camera, T_world_cam), noise_grey, seed=index)
    return Frame(index, index * FRAME_NS, image)


def frames_along(corner: Corner, camera: CameraModel, poses: list[Mat4]) -> list[Frame]:
    """One frame for each pose."""
    return [frame_of(corner, camera, T, n) for n, T in enumerate(poses)]


def sideways(n: int, step_m: float = 0.012) -> list[Mat4]:
    """Poses of a camera that moves to the right and turns a little."""
    return [
        se3.exp([step_m * i - 0.2, 0.004 * i, 0.0, 0.0, -0.002 * i, 0.001 * i]) for i in range(n)
    ]


def forward(n: int, step_m: float = 0.03) -> list[Mat4]:
    """Poses of a camera that goes straight ahead."""
    return [se3.exp([0.001 * i, 0.0, step_m * i - 0.4, 0.0, 0.001 * i, 0.0]) for i in range(n)]


def turning(n: int, step_rad: float = 0.008) -> list[Mat4]:
    """Poses of a camera that turns on the spot."""
    return [se3.exp([0, 0, 0, 0.3 * step_rad * i, step_rad * (i - n / 2), 0]) for i in range(n)]


def wandering(n: int) -> list[Mat4]:
    """Poses of a camera that walks to and fro, so that keyframes come and go."""
    poses = []
    for t in 0.022 * np.arange(n):
        place = [0.9 * np.sin(t), 0.25 * np.sin(1.7 * t), 0.5 * np.sin(0.9 * t)]
        turn = [0.06 * np.sin(2.1 * t), 0.12 * np.sin(1.3 * t), 0.05 * np.sin(1.9 * t)]
        poses.append(se3.exp([*place, 0, 0, 0]) @ se3.exp([0, 0, 0, *turn]))
    return poses


def centres(poses: list[Mat4]) -> F64:
    """Camera centres (n, 3) of T_world_cam."""
    return np.stack([T[:3, 3] for T in poses])


def rmse_after_similarity(estimate: F64, truth: F64) -> float:
    """Root mean square distance of points (n, 3) after the best similarity (Umeyama 1991)."""
    a, b = estimate - estimate.mean(axis=0), truth - truth.mean(axis=0)
    U, d, Vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    scale = float((d * sign).sum() / (a**2).sum())
    return float(np.sqrt(np.mean(np.sum((scale * a @ ((U * sign) @ Vt).T - b) ** 2, axis=1))))


def rolling_image(
    corner: Corner, camera: CameraModel, T_middle: Mat4, rate_rad_s: float, readout_s: float
) -> F64:
    """Grey values (h, w) of rows read one after another while turning about the vertical axis."""
    u = np.arange(camera.width, dtype=np.float64)
    rows = []
    for v in range(camera.height):
        late_s = readout_s * ((v + 0.5) / camera.height - 0.5)
        T = T_middle @ se3.exp([0, 0, 0, 0, rate_rad_s * late_s, 0])
        rows.append(corner.image_at(camera, T, u, np.full_like(u, v)))
    return np.array(rows)
