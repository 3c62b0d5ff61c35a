# SPDX-License-Identifier: Apache-2.0
"""A map from above, with its changes."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.runtime.drawing import Colour, width_of, write
from edge.tiles.reader import Map
from edge.types import F64, U8, ChangeEvent, Mat4

COLOURS: dict[str, Colour] = {"added": (60, 200, 60), "removed": (60, 60, 230)}
_WORDS: dict[str, Colour] = {"added": (20, 110, 20), "removed": (20, 20, 170)}
_PAPER: Colour = (248, 248, 248)
_MARGIN = 0.06
_MAX_POINTS = 40_000
_POINT, _PATH, _CAMERA = (120, 110, 100), (235, 205, 160), (200, 120, 20)
_LINE_PX = 24  # from one line of words to the next
_HALF_LETTER_PX = 8
_SIGHT_M = 0.6  # length of the cone that shows where the camera looks


class MapPlan:
    """Draws one map from above. Owned by one thread."""

    def __init__(self, map_: Map, side_px: int) -> None:
        self._side = side_px
        self._turn = _level(-map_.T_map_cam[:, :3, 1].mean(axis=0))
        step = max(1, map_.n_points // _MAX_POINTS)
        xyz = map_.points(np.arange(0, map_.n_points, step, dtype=np.int32)).xyz
        flat, centres = xyz @ self._turn.T, map_.T_map_cam[:, :3, 3] @ self._turn.T
        low, high = np.percentile(np.vstack((flat, centres)), (1, 99), axis=0)[:, :2]
        self._middle: F64 = 0.5 * (low + high)
        self._px_per_m = side_px * (1.0 - 2.0 * _MARGIN) / float(max((high - low).max(), 1e-6))
        self._ground: U8 = np.full((side_px, side_px, 3), _PAPER, np.uint8)
        for column, row in self._place(centres).tolist():
            cv2.circle(self._ground, (column, row), 2, _PATH, -1, cv2.LINE_AA)
        columns, rows = self._place(flat).T
        inside = (columns >= 0) & (columns < side_px) & (rows >= 0) & (rows < side_px)
        self._ground[rows[inside], columns[inside]] = _POINT
        self._draw_scale(metric=map_.manifest.metric)

    def draw(self, events: Sequence[ChangeEvent], T_map_cam: Mat4 | None = None) -> U8:
        """The map (h, w, 3) with these changes, the way of what was moved, and the camera."""
        picture = self._ground.copy()
        if T_map_cam is not None:
            self._draw_camera(picture, T_map_cam)
        places = {event.id: self.pixel(event.center_map_m) for event in events}
        for event in events:
            at, colour = places[event.id], COLOURS[event.kind]
            cv2.circle(picture, at, self._radius(event), colour, 3, cv2.LINE_AA)
            if event.partner in places:
                cv2.arrowedLine(picture, places[event.partner], at, colour, 2, cv2.LINE_AA)
        row = 0
        for event in sorted(events, key=lambda event: places[event.id][1]):
            column, middle = places[event.id]
            row = max(row + _LINE_PX, middle + _HALF_LETTER_PX)  # no words over others
            words = f"{event.id} {event.kind} {event.label}"
            width, beside = width_of(picture, words), self._radius(event) + _HALF_LETTER_PX
            fits = column + beside + width < self._side
            left = column + beside if fits else column - beside - width
            write(picture, words, (left, row), _WORDS[event.kind], _PAPER)
        return picture

    def _radius(self, event: ChangeEvent) -> int:
        return max(round(0.5 * float(np.linalg.norm(event.extent_m)) * self._px_per_m), 6)

    def _draw_scale(self, *, metric: bool) -> None:
        """A bar of 1, 10, 100 or so metres, or units of the map."""
        length = 10.0 ** np.floor(np.log10(0.5 * self._side / self._px_per_m))
        left, row = 14, self._side - 14
        right = left + round(length * self._px_per_m)
        cv2.line(self._ground, (left, row), (right, row), (0, 0, 0), 2)
        words = f"{length:g} {'m' if metric else 'units of the map'}"
        write(self._ground, words, (left, row - 6.0), (0, 0, 0), _PAPER)

    def _draw_camera(self, picture: U8, T_map_cam: Mat4) -> None:
        at = self.pixel(T_map_cam[:3, 3])
        for side in (-0.5, 0.5):
            ahead = T_map_cam[:3, :3] @ np.array([side, 0.0, 1.0])
            tip = self.pixel(T_map_cam[:3, 3] + _SIGHT_M * ahead)
            cv2.line(picture, at, tip, _CAMERA, 2, cv2.LINE_AA)
        cv2.circle(picture, at, 6, _CAMERA, -1, cv2.LINE_AA)

    def pixel(self, place: F64) -> tuple[int, int]:
        """Column and row at which a place (3,) of the map is drawn."""
        column, row = self._place((self._turn @ place)[None])[0].tolist()
        return int(column), int(row)

    def _place(self, flat: F64) -> NDArray[np.int64]:
        scaled = (flat[:, :2] - self._middle) * self._px_per_m
        scaled[:, 1] *= -1.0
        return np.asarray(np.rint(scaled + 0.5 * self._side), np.int64)


def _level(up: F64) -> F64:
    """Rotation (3, 3) that turns `up` to +z."""
    z = up / max(float(np.linalg.norm(up)), 1e-9)
    x = np.cross((0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (0.0, 0.0, 1.0), z)
    x /= np.linalg.norm(x)
    return np.stack((x, np.cross(z, x), z))
