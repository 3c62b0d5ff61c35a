# SPDX-License-Identifier: Apache-2.0
"""The images that a map is made of, chosen from recordings."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.errors import RecordingError
from edge.geometry.camera import CameraModel
from edge.tiles.manifest import is_length
from edge.types import Mat4

_RIGID_TOLERANCE = 1e-6
_MAX_CAMERAS = 256  # a keyframe names its camera in a byte


class View(NamedTuple):
    """One posed image."""

    sequence: int  # in ViewSet.recordings
    image: int  # in its recording
    t_ns: int
    T_map_cam: Mat4
    camera: int  # in ViewSet.cameras


class Origin(NamedTuple):
    """Where poses come from, and their unit."""

    poses: str = "given"  # or sfm
    metric: bool = True
    scale: str = "given"  # what the unit comes from
    # Factor of the depth images of each sequence; none is none to apply.
    depth_scale: tuple[float, ...] = ()


class ViewSet(NamedTuple):
    """All views of a build, in the order of the sequences and of time."""

    roots: list[Path]
    cameras: list[CameraModel]
    views: list[View]
    skipped: int  # chosen images without a pose
    calibrations: list[CameraModel]  # as the recordings give them, where `cameras` are better
    origin: Origin = Origin()
    # By recording and camera, where found: how long their rows took to read [s], from the first to
    # the last. Features are freed of it.
    readouts: Mapping[tuple[int, int], float] = MappingProxyType({})


def choose_views(
    sequences: Iterable[Path], frames: slice | None, every: int, exclude: frozenset[int]
) -> ViewSet:
    """Posed views of the sequences; RecordingError where a build makes no sense.

    `frames` and `exclude` are indices into each sequence; `every` takes each k-th of `frames`,
    so that leaving one out moves no other.
    """
    recordings = [open_recording(root, frames=frames, stride=every) for root in sequences]
    metric = {recording.metric for recording in recordings}
    if len(metric) > 1:
        raise RecordingError(
            f"{recordings[0].root}: poses in metres cannot be joined with such in a unit of their "
            "own; use --poses sfm for all, or build apart"
        )
    chosen = _choose(recordings, exclude, _pose_reader)
    if not chosen.views:
        root = recordings[0].root
        raise RecordingError(f"{root}: no chosen image has a pose in groundtruth.txt; add some")
    scale = "given" if metric == {True} else "none"
    return chosen._replace(origin=Origin(metric=metric == {True}, scale=scale))


def choose_unposed(
    sequences: Iterable[Path], frames: slice | None, every: int, exclude: frozenset[int]
) -> ViewSet:
    """Views as `choose_views` gives them, but all at the origin, whether there are poses or not."""
    recordings = [open_recording(root, frames=frames, stride=every) for root in sequences]
    chosen = _choose(recordings, exclude, lambda _: lambda _: np.eye(4))
    if len(chosen.views) < 2:
        raise RecordingError(f"{recordings[0].root}: --poses sfm needs two images at least")
    return chosen


def _choose(
    recordings: list[Recording],
    exclude: frozenset[int],
    reader: Callable[[Recording], Callable[[int], Mat4 | None]],
) -> ViewSet:
    """Views of all chosen images whose pose the recording's `reader` knows."""
    cameras = list(dict.fromkeys(c for recording in recordings for c in recording.cameras))
    if len(cameras) > _MAX_CAMERAS:
        raise RecordingError(
            f"{recordings[0].root}: has {len(cameras)} cameras, a map holds {_MAX_CAMERAS}; "
            "let images share a calibration"
        )
    number = {camera: i for i, camera in enumerate(cameras)}
    last = max(len(recording.t_ns) for recording in recordings) - 1
    if exclude and max(exclude) > last:
        raise RecordingError(
            f"{recordings[0].root}: --exclude {max(exclude)}: its images are 0 to {last}"
        )
    views: list[View] = []
    skipped = 0
    for sequence, recording in enumerate(recordings):
        pose_of = reader(recording)
        for index in map(int, recording.indices):
            if index in exclude:
                continue
            if (T := pose_of(index)) is None:
                skipped += 1
                continue
            t_ns, camera = int(recording.t_ns[index]), number[recording.camera_at(index)]
            views.append(View(sequence, index, t_ns, T, camera))
    roots = [recording.root for recording in recordings]
    return ViewSet(roots, cameras, views, skipped, list(cameras))


def _pose_reader(recording: Recording) -> Callable[[int], Mat4 | None]:
    """Poses of a recording by the index of an image."""
    truth = recording.groundtruth
    if truth is None:
        raise RecordingError(
            f"{recording.root}: has no poses; add groundtruth.txt, or find them with --poses sfm"
        )

    def pose_of(index: int) -> Mat4 | None:
        T = truth.pose_at(int(recording.t_ns[index]))
        if T is not None:
            _check_pose(T, f"{recording.root}: pose of image {index}")
        return T

    return pose_of


def _check_pose(T: Mat4, where: str) -> None:
    R = T[:3, :3]
    if not np.isfinite(T).all():
        raise RecordingError(f"{where} is not finite; correct it in groundtruth.txt")
    if not all(is_length(value) for value in T[:3, 3]):
        raise RecordingError(
            f"{where} is {np.abs(T[:3, 3]).max():.1g} from the origin; correct it in "
            "groundtruth.txt"
        )
    if np.abs(R @ R.T - np.eye(3)).max() > _RIGID_TOLERANCE or np.linalg.det(R) < 0.0:
        raise RecordingError(f"{where} is no rigid transform; correct it in groundtruth.txt")
