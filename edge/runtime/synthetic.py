# SPDX-License-Identifier: Apache-2.0
"""A tiny made-up recording: a camera goes along a textured wall. For warming up only."""

from collections.abc import Iterator
from functools import cache

import cv2
import numpy as np

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import F64, U8, Frame, Mat4

CAMERA = CameraModel(640, 480, 560.0, 560.0, 319.5, 239.5)
RATE_HZ = 30.0
WALL_M = 6.4  # width and height of the wall, which the map's z axis meets at its middle
DISTANCE_M = 2.0
_TEXTURE_PX = 1600


class WallDrive:
    """A camera that goes along a wall; frames `blind` show noise only.

    It turns to and fro, so that the wall's depth differs over the image.
    """

    rate_hz = RATE_HZ
    dropped = 0

    def __init__(self, count: int, camera: CameraModel = CAMERA, blind: range = range(0)) -> None:
        self.camera = camera  # its lens is left out: images are those of the ideal camera
        self._count = count
        self._blind = blind
        self._texture = _texture()

    def __iter__(self) -> Iterator[Frame]:
        """All frames."""
        for index in range(self._count):
            image = self.image(index)
            image.flags.writeable = False  # as cameras give them: to Numba that is another type
            yield Frame(index, round(index * 1e9 / RATE_HZ), image)

    def pose(self, index: int) -> Mat4:
        """T_map_cam of a frame."""
        along = 0.02 * index - 0.5
        turn = 0.15 * np.sin(0.1 * index) + 0.2
        return se3.exp([along, 0.1 * np.sin(0.07 * index), 0.0, 0, 0, 0]) @ se3.exp(
            [0, 0, 0, 0, turn, 0]
        )

    def image(self, index: int) -> U8:
        """Image (h, w) of a frame."""
        if index in self._blind:
            rng = np.random.default_rng(index)
            return rng.integers(0, 256, (self.camera.height, self.camera.width), np.uint8)
        H_image_texture = self._homography(self.pose(index))
        image: U8 = cv2.warpPerspective(
            self._texture,
            H_image_texture,
            (self.camera.width, self.camera.height),
            flags=cv2.INTER_AREA,
        )
        return image

    def depth(self, index: int) -> F64:
        """Depth along z (h, w) [m] of a frame."""
        v, u = np.mgrid[: self.camera.height, : self.camera.width]
        rays = np.dstack(
            (
                (u - self.camera.cx) / self.camera.fx,
                (v - self.camera.cy) / self.camera.fy,
                np.ones(u.shape),
            )
        )
        T_map_cam = self.pose(index)
        depth: F64 = (DISTANCE_M - T_map_cam[2, 3]) / (rays @ T_map_cam[2, :3])
        return depth

    def _homography(self, T_map_cam: Mat4) -> F64:
        """Takes texture pixels to image pixels."""
        T_cam_map = se3.inverse(T_map_cam)
        metres = WALL_M / _TEXTURE_PX
        # Columns: one texture pixel along x, one along y, and the texture's corner.
        map_texture = np.array(
            [
                [metres, 0.0, -0.5 * WALL_M],
                [0.0, metres, -0.5 * WALL_M],
                [0.0, 0.0, DISTANCE_M],
                [0.0, 0.0, 1.0],
            ]
        )
        K = np.array(
            [
                [self.camera.fx, 0.0, self.camera.cx],
                [0.0, self.camera.fy, self.camera.cy],
                [0.0, 0.0, 1.0],
            ]
        )
        H: F64 = K @ (T_cam_map[:3] @ map_texture)
        return H


@cache
def _texture() -> U8:
    """Blobs of all sizes: corners for every octave, gradients everywhere."""
    rng = np.random.default_rng(7)
    size = (_TEXTURE_PX, _TEXTURE_PX)
    # All in place: this would be the largest thing that the runtime ever holds.
    texture, layer = np.zeros(size, np.float32), np.empty(size, np.float32)
    for cells, contrast in ((50, 40.0), (200, 50.0), (400, 40.0)):
        coarse = rng.uniform(-1.0, 1.0, (cells, cells)).astype(np.float32)
        cv2.resize(coarse, size, dst=layer, interpolation=cv2.INTER_CUBIC)
        layer *= contrast
        texture += layer
    texture += 128.0
    np.clip(texture, 0, 255, out=texture)
    grey: U8 = texture.astype(np.uint8)
    return grey
