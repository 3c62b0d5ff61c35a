# SPDX-License-Identifier: Apache-2.0
"""Pictures of changes for people: what the camera saw, what the map knows there, and where."""

import cv2
import numpy as np

from edge.geometry.camera import CameraModel
from edge.outputs.report import FrameReport
from edge.outputs.run_folder import RunFolder
from edge.runtime.drawing import Colour, border, title
from edge.runtime.map_plan import COLOURS, MapPlan
from edge.runtime.map_view import MapView
from edge.tiles.reader import Map
from edge.types import U8, ChangeEvent, Evidence, Mask

_PANEL_PX = 360  # height of each of four panels
_BAR_PX = 26  # of words above each
_PLAN_PX = 2 * _PANEL_PX + _BAR_PX
_AROUND = 3.0  # times the size of the change: what a close-up shows
_LEAST_PX = 120  # a side of it


class ChangePictures:
    """Puts a picture of each change into a run folder, and one of the map with all of them.

    Owned by the tracking thread.
    """

    def __init__(self, folder: RunFolder, map_: Map, camera: CameraModel) -> None:
        self._folder = folder
        self._plan = MapPlan(map_, _PLAN_PX)
        self._view = MapView(map_, camera)
        self._events: list[ChangeEvent] = []

    def write(self, report: FrameReport) -> None:
        """Draw the changes of one frame."""
        for event in report.changes:
            self.add(event)

    def add(self, event: ChangeEvent) -> None:
        """Draw one change."""
        self._events.append(event)
        self._save(f"change-{event.id:03d}.png", self._draw(event))

    def finish(self) -> None:
        """Draw the map with all changes, if there are any."""
        if self._events:
            words = f"{len(self._events)} changes in the map from above; light blue: its keyframes"
            self._save("changes.png", title(self._plan.draw(self._events), words))

    def _draw(self, event: ChangeEvent) -> U8:
        shown = _last_view(event)
        plan = self._plan.draw([event], None if shown is None else shown.T_map_cam)
        plan = title(plan, "the map from above; blue: the camera, light blue: keyframes")
        if shown is None or event.image is None:
            return plan
        now: U8 = cv2.cvtColor(event.image, cv2.COLOR_GRAY2BGR)
        box = event.center_map_m, event.extent_m
        before = self._view.draw(shown.T_map_cam, event.image, box)
        words = f"now: {event.kind} {event.label}, {event.score:.2f}, {event.n_views} viewpoints"
        panels = []
        for picture, name in ((now, words), (before, "what the map knows: red is near, blue far")):
            close = picture
            if shown.mask is not None:
                close = _close_up(picture, shown.mask, COLOURS[event.kind])
                border(picture, shown.mask, COLOURS[event.kind])
            panels.append(np.vstack((title(_fit(picture), name), title(_fit(close), "close up"))))
        return np.hstack((*panels, plan))

    def _save(self, name: str, picture: U8) -> None:
        self._folder.add(name, cv2.imencode(".png", picture)[1].tobytes())


def _last_view(event: ChangeEvent) -> Evidence | None:
    """The view that the event's image is of."""
    views = [view for view in event.evidence if view.t_ns == event.t_ns]
    return views[-1] if views else None


def _fit(picture: U8) -> U8:
    scale = _PANEL_PX / picture.shape[0]
    size = (round(scale * picture.shape[1]), _PANEL_PX)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def _close_up(picture: U8, mask: Mask, colour: Colour) -> U8:
    """The part of the picture around a mask, of the picture's own proportions and size."""
    h, w = picture.shape[:2]
    rows, columns = mask.inside.shape
    height = min(max(_AROUND * rows, _AROUND * columns * h / w, _LEAST_PX), h)
    width = height * w / h
    top = int(np.clip(mask.top + 0.5 * rows - 0.5 * height, 0, h - height))
    left = int(np.clip(mask.left + 0.5 * columns - 0.5 * width, 0, w - width))
    part = picture[top : top + int(height), left : left + int(width)]
    close: U8 = np.asarray(cv2.resize(part, (w, h), interpolation=cv2.INTER_CUBIC), np.uint8)
    border(close, mask, colour, (left, top), h / int(height))
    return close
