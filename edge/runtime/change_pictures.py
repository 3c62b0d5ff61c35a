# SPDX-License-Identifier: Apache-2.0
"""Pictures of changes for people: what the camera saw, and where on the map."""

import cv2
import numpy as np

from edge.outputs.report import FrameReport
from edge.outputs.run_folder import RunFolder
from edge.tiles.reader import Map
from edge.types import F64, U8, ChangeEvent, Mask

_SIDE_PX = 480  # of the map's panel
_MARGIN = 0.05
_MAX_POINTS = 20_000
_COLOURS = {"added": (60, 200, 60), "removed": (60, 60, 230)}  # blue, green, red
_CAMERA, _POINT = (200, 140, 40), (150, 150, 150)


class ChangePictures:
    """Puts a picture of each change into a run folder, and one of the map with all of them.

    Owned by the tracking thread.
    """

    def __init__(self, folder: RunFolder, map_: Map) -> None:
        self._folder = folder
        self._plan = _Plan(map_)
        self._events: list[ChangeEvent] = []

    def write(self, report: FrameReport) -> None:
        """Draw the changes of one frame."""
        for event in report.changes:
            self.add(event)

    def add(self, event: ChangeEvent) -> None:
        """Draw one change."""
        self._events.append(event)
        panel = self._plan.draw([event])
        if event.evidence:
            at = self._plan.pixel(event.evidence[-1].T_map_cam[:3, 3])
            cv2.circle(panel, at, 5, _CAMERA, -1, cv2.LINE_AA)
        if event.image is not None:
            panel = np.hstack([_seen(event, event.image), panel])
        self._save(f"change-{event.id:03d}.png", panel)

    def finish(self) -> None:
        """Draw the map with all changes, if there are any."""
        if self._events:
            self._save("changes.png", self._plan.draw(self._events))

    def _save(self, name: str, picture: U8) -> None:
        self._folder.add(name, cv2.imencode(".png", picture)[1].tobytes())


class _Plan:
    """The map from above."""

    def __init__(self, map_: Map) -> None:
        self._turn = _level(-map_.T_map_cam[:, :3, 1].mean(axis=0))
        step = max(1, map_.n_points // _MAX_POINTS)
        xyz = map_.points(np.arange(0, map_.n_points, step, dtype=np.int32)).xyz
        flat, centres = xyz @ self._turn.T, map_.T_map_cam[:, :3, 3] @ self._turn.T
        low, high = np.percentile(np.vstack((flat, centres)), (2, 98), axis=0)[:, :2]
        self._low = low
        self._px_per_m = _SIDE_PX * (1.0 - 2.0 * _MARGIN) / float(max((high - low).max(), 1e-6))
        self._ground: U8 = np.full((_SIDE_PX, _SIDE_PX, 3), 255, np.uint8)
        columns, rows = self._place(flat).T
        inside = (columns >= 0) & (columns < _SIDE_PX) & (rows >= 0) & (rows < _SIDE_PX)
        self._ground[rows[inside], columns[inside]] = _POINT

    def pixel(self, place: F64) -> tuple[int, int]:
        """Where a place (3,) of the map is drawn."""
        column, row = self._place((self._turn @ place)[None])[0]
        return int(column), int(row)

    def draw(self, events: list[ChangeEvent]) -> U8:
        """The map (h, w, 3) with these changes, and the way from where a thing was moved."""
        picture = self._ground.copy()
        places = {event.id: self.pixel(event.center_map_m) for event in events}
        for event in events:
            at, colour = places[event.id], _COLOURS[event.kind]
            radius = round(0.5 * float(np.linalg.norm(event.extent_m)) * self._px_per_m)
            cv2.circle(picture, at, max(radius, 4), colour, 2, cv2.LINE_AA)
            _write(picture, f"{event.kind} {event.label}", (at[0] + 8, at[1] - 6), colour)
            if event.partner in places:
                cv2.line(picture, places[event.partner], at, colour, 1, cv2.LINE_AA)
        return picture

    def _place(self, flat: F64) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
        scaled = (flat[:, :2] - self._low) * self._px_per_m + _MARGIN * _SIDE_PX
        scaled[:, 1] = _SIDE_PX - scaled[:, 1]
        return np.asarray(np.rint(scaled), np.int64)


def _level(up: F64) -> F64:
    """Rotation (3, 3) that turns `up` to +z."""
    z = up / max(float(np.linalg.norm(up)), 1e-9)
    x = np.cross((0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (0.0, 0.0, 1.0), z)
    x /= np.linalg.norm(x)
    return np.stack((x, np.cross(z, x), z))


def _seen(event: ChangeEvent, image: U8) -> U8:
    """The image with the outline of what is there, or should be."""
    picture: U8 = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    colour = _COLOURS[event.kind]
    if event.evidence and event.evidence[-1].mask is not None:
        _outline(picture, event.evidence[-1].mask, colour)
    text = f"{event.kind} {event.label} {event.score:.2f}, {event.n_views} viewpoints"
    _write(picture, text, (8, 20), colour)
    scale = _SIDE_PX / picture.shape[0]
    return np.asarray(cv2.resize(picture, None, fx=scale, fy=scale), np.uint8)


def _outline(picture: U8, mask: Mask, colour: tuple[int, int, int]) -> None:
    inside = np.pad(mask.inside.astype(np.uint8), 1)
    contours, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    moved = [contour + np.array([mask.left - 1, mask.top - 1]) for contour in contours]
    cv2.drawContours(picture, moved, -1, colour, 2)


def _write(picture: U8, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    font = cv2.FONT_HERSHEY_SIMPLEX
    shadow = (at[0] + 1, at[1] + 1)
    cv2.putText(picture, text, shadow, font, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.putText(picture, text, at, font, 0.45, colour, 1, cv2.LINE_AA)
