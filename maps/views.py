# SPDX-License-Identifier: Apache-2.0
"""The posed images that a map is made of, chosen from recordings."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.errors import RecordingError
from edge.geometry.camera import CameraModel
from edge.types import Mat4

_RIGID_TOLERANCE = 1e-6


class View(NamedTuple):
    """One posed image."""

    sequence: int  # in ViewSet.recordings
    image: int  # in its recording
    t_ns: int
    T_map_cam: Mat4
    camera: int  # in ViewSet.cameras


class ViewSet(NamedTuple):
    """All views of a build, in the order of the sequences and of time."""

    roots: list[Path]
    cameras: list[CameraModel]
    views: list[View]
    skipped: int  # chosen images without a pose


def choose_views(
    sequences: Iterable[Path], frames: slice | None, every: int, exclude: frozenset[int]
) -> ViewSet:
    """Posed views of the sequences; RecordingError where a build makes no sense.

    `frames` and `exclude` are indices into each sequence; `every` takes each k-th of `frames`,
    so that leaving one out moves no other.
    """
    roots: list[Path] = []
    cameras: list[CameraModel] = []
    views: list[View] = []
    skipped = 0
    for number, root in enumerate(sequences):
        recording = open_recording(root, frames=frames, stride=every)
        roots.append(recording.root)
        if recording.camera not in cameras:
            cameras.append(recording.camera)
        camera = cameras.index(recording.camera)
        found = _posed(recording, number, camera, exclude)
        skipped += len(recording) - len(found) - len(exclude.intersection(recording.indices))
        views += found
    if not views:
        raise RecordingError(f"{roots[0]}: no chosen image has a pose in groundtruth.txt; add some")
    return ViewSet(roots, cameras, views, skipped)


def _posed(recording: Recording, sequence: int, camera: int, exclude: frozenset[int]) -> list[View]:
    truth = recording.groundtruth
    if truth is None:
        raise RecordingError(
            f"{recording.root}: has no poses; a map is built from posed images: add groundtruth.txt"
        )
    views = []
    for index in map(int, recording.indices):
        t_ns = int(recording.t_ns[index])
        T = None if index in exclude else truth.pose_at(t_ns)
        if T is not None:
            _check_pose(T, f"{recording.root}: pose of image {index}")
            views.append(View(sequence, index, t_ns, T, camera))
    return views


def _check_pose(T: Mat4, where: str) -> None:
    R = T[:3, :3]
    if not np.isfinite(T).all():
        raise RecordingError(f"{where} is not finite; correct it in groundtruth.txt")
    if np.abs(R @ R.T - np.eye(3)).max() > _RIGID_TOLERANCE or np.linalg.det(R) < 0.0:
        raise RecordingError(f"{where} is no rigid transform; correct it in groundtruth.txt")
