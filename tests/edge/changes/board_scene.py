# SPDX-License-Identifier: Apache-2.0
"""A painted board before a painted wall: exact images, depths and maps of both states."""

from pathlib import Path

import cv2
import numpy as np

from edge.geometry import se3
from edge.tiles.reader import Map, open_map
from edge.types import F64, U8, Bools, DepthSamples, Look, Mat4
from maps.build import BuildInput, build
from maps.settings import BuildSettings
from tests.maps.drive_folder import KnownView, write_drive
from tests.maps.wall_drive import CAMERA, WALL_Z_M, depth, picture, poses, wall

BOARD = np.array([0.1, 0.05, 1.3])  # its middle [m]
SIDE_M = 0.3
N_LIVE = 10
_PAINT, _BOARD_PAINT = wall(), wall(5)[100:300, 100:300]
_STEP_PX = 6  # between depths


def make_map(folder: Path, *, with_board: bool) -> Map:
    views = (KnownView(image(T, with_board=with_board), T) for T in poses(12))
    drive = write_drive(folder / "drive", CAMERA, views, first_s=1.0)
    build(BuildInput([drive]), folder / "map", BuildSettings(lens="given"))
    return open_map(folder / "map")


def look(index: int, *, with_board: bool, with_depth: bool = True, light: float = 1.0) -> Look:
    """A view from elsewhere than those of the map."""
    T = poses(N_LIVE, seed=3)[index % N_LIVE]
    seen = np.clip(light * image(T, with_board=with_board), 0, 255).astype(np.uint8)
    measured = depths(T, with_board=with_board) if with_depth else None
    return Look(index, 100_000_000 * index, seen, T, np.empty((0, 3)), None, measured)


def image(T: Mat4, *, with_board: bool) -> U8:
    """What the camera sees."""
    seen = picture(_PAINT, T)
    if not with_board:
        return seen
    n = len(_BOARD_PAINT)
    own = np.array([[0, 0], [n, 0], [n, n], [0, n]], np.float32)
    H = cv2.getPerspectiveTransform(own, _corners(T).astype(np.float32))
    size = (CAMERA.width, CAMERA.height)
    over = cv2.warpPerspective(_BOARD_PAINT, H, size, flags=cv2.INTER_AREA)
    return np.where(_mask(T), over, seen)


def depths(T: Mat4, *, with_board: bool) -> DepthSamples:
    """Depths of a grid of pixels, 1 % sure."""
    v, u = np.mgrid[3 : CAMERA.height : _STEP_PX, 3 : CAMERA.width : _STEP_PX]
    metres = depth(T)
    if with_board:  # a plane along the wall
        nearer = (BOARD[2] - T[2, 3]) / (WALL_Z_M - T[2, 3])
        metres = np.where(_mask(T), nearer * metres, metres)
    inverse = (1.0 / metres[v, u]).ravel().astype(np.float32)
    pixels = np.column_stack((u.ravel(), v.ravel())).astype(np.float32)
    return DepthSamples(pixels, inverse, np.float32(0.01) * inverse)


def _corners(T: Mat4) -> F64:
    half = 0.5 * SIDE_M
    square = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    return CAMERA.project(se3.transform(se3.inverse(T), BOARD + square))


def _mask(T: Mat4) -> Bools:
    filled = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    cv2.fillConvexPoly(filled, np.round(_corners(T)).astype(np.int32), 1)
    return filled > 0
