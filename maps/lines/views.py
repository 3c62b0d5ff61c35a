# SPDX-License-Identifier: Apache-2.0
"""The segments of all images of a build, and which images tell their depths."""

import threading
from functools import partial
from pathlib import Path
from secrets import token_hex
from typing import NamedTuple

import cv2
import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.config.lines import SegmentConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.lines.detector import SegmentDetector
from edge.lines.line import Segments
from edge.lines.threeview import Drawn, Posed, drawn
from edge.runtime.progress import progress
from edge.types import F32, I32, U8, Mat4, Pinhole
from maps.points import StoredPoints
from maps.survey import Survey
from maps.views import View, ViewSet
from maps.work_folder import key_of, stamp

_NEIGHBOURS = 8
_MAX_TURN_DEG = 35.0  # between the axes of views that are matched
_BASELINES = (0.015, 0.4)  # of the scene's depth
_NEARER, _FARTHER = 0.4, 2.5  # than the points of a view
_FEW_POINTS = 12
_NO_POINTS_RANGE = (0.3, 30.0)  # depths, where no view sees enough of them


class SegmentContext(NamedTuple):
    """What all views have in common."""

    roots: tuple[Path, ...]
    cameras: tuple[CameraModel, ...]
    build: str  # drawn anew by each build


class _Remembered(threading.local):
    """What a thread last opened."""

    context: SegmentContext | None = None
    recordings: dict[int, Recording]
    maps: dict[int, tuple[F32, F32, U8]]
    detector: SegmentDetector


_remembered = _Remembered()


def find_segments(context: SegmentContext, view: View) -> Drawn:
    """The segments of one view, through its ideal camera; runs wherever the work is done."""
    if _remembered.context != context:
        cv2.setNumThreads(1)
        _remembered.context = context
        _remembered.recordings, _remembered.maps = {}, {}
        _remembered.detector = SegmentDetector(SegmentConfig())
    recordings = _remembered.recordings
    if view.sequence not in recordings:
        recordings[view.sequence] = open_recording(context.roots[view.sequence])
    image = recordings[view.sequence].needed_image(view.image)
    camera = context.cameras[view.camera]
    valid: U8 | None = None
    if camera.distortion_model != "none":
        if view.camera not in _remembered.maps:
            _remembered.maps[view.camera] = camera.undistortion_maps()
        tables = _remembered.maps[view.camera]
        map_x, map_y, valid = tables
        image = np.asarray(cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR), np.uint8)
    return drawn(image, _remembered.detector.detect(image, valid))


def posed_segments(chosen: ViewSet, survey: Survey, camera: Pinhole) -> list[Posed]:
    """Segments of all views, in the pixels of the first camera."""
    context = SegmentContext(tuple(chosen.roots), tuple(chosen.cameras), token_hex(8))
    recordings = [open_recording(root) for root in chosen.roots]
    keys = []
    for view in chosen.views:
        files = [stamp(path) for path in recordings[view.sequence].files(view.image)]
        keys.append(key_of("segments", SegmentConfig(), chosen.cameras[view.camera], *files))
    run = partial(find_segments, context)
    found = survey.work.map(survey.workers, run, chosen.views, keys, Drawn)
    views = []
    for view, seen in zip(chosen.views, progress(found, len(keys), "segments"), strict=True):
        segments = _through(seen.segments, chosen.cameras[view.camera].pinhole, camera)
        views.append(Posed(Drawn(segments, seen.grey), se3.inverse(view.T_map_cam)))
    return views


def _through(segments: Segments, own: Pinhole, camera: Pinhole) -> Segments:
    """Segments as another camera at the same place would see them."""
    if own == camera:
        return segments
    gain = np.array([camera.fx / own.fx, camera.fy / own.fy])
    middle = (segments.middle - [own.cx, own.cy]) * gain + [camera.cx, camera.cy]
    span = segments.direction * gain
    stretch = np.linalg.norm(span, axis=1)
    return Segments(
        middle, span / stretch[:, None], segments.length * stretch, segments.sigma * gain.mean()
    )


def choose_neighbours(
    views: list[Posed], points: StoredPoints
) -> list[tuple[list[int], tuple[float, float]]]:
    """Of each view those to match it with, and the depths that occur in it."""
    T = np.array([se3.inverse(view.T_cam_lines) for view in views])
    depths = [_depths(points, T[k], points.point[k]) for k in range(len(views))]
    known = [d for d in depths if d is not None]
    usual = (min(d[0] for d in known), max(d[1] for d in known)) if known else _NO_POINTS_RANGE
    found = []
    for k in range(len(views)):
        near, far = depths[k] or usual
        depth = float(np.sqrt(near * far))
        away = np.linalg.norm(T[:, :3, 3] - T[k, :3, 3], axis=1) / depth
        turn = np.arccos(np.clip(T[:, :3, 2] @ T[k, :3, 2], -1.0, 1.0))
        good = (away > _BASELINES[0]) & (away < _BASELINES[1])
        others = np.flatnonzero(good & (turn < np.deg2rad(_MAX_TURN_DEG)))
        others = others[np.argsort(away[others], kind="stable")]
        # Near ones show the same segments, far ones tell their depths.
        if len(others) > _NEIGHBOURS:
            others = others[np.linspace(0, len(others) - 1, _NEIGHBOURS).astype(int)]
        found.append((others.tolist(), (near, far)))
    return found


def _depths(points: StoredPoints, T_map_cam: Mat4, seen: I32) -> tuple[float, float] | None:
    """Depths between which the lines of a view lie."""
    depth = (points.xyz[seen] - T_map_cam[:3, 3]) @ T_map_cam[:3, 2]
    depth = depth[depth > 0.0]
    if len(depth) < _FEW_POINTS:
        return None
    near, far = np.percentile(depth, (5.0, 95.0))
    return float(_NEARER * near), float(_FARTHER * far)
