# SPDX-License-Identifier: Apache-2.0
"""Metres for poses that have none: from known poses, a known distance, a marker or depth.

A hint of the command line is one of `given`, `metres`, `depth`, `distance:I,J=METRES` and
`marker:FAMILY=SIDE_M`.
"""

import math
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from edge.cameras.recording import Recording
from edge.errors import ConfigError, RecordingError
from edge.geometry import so3
from edge.geometry.camera import CameraModel
from edge.geometry.sim3 import Sim3
from edge.markers.finder import MarkerFinder
from edge.types import F64, Mat4
from maps.markers import MarkerImage, sides, sightings_in, squares
from maps.views import View

FORMS = "given, metres, depth, distance:I,J=METRES or marker:FAMILY=SIDE_M"

_MIN_SAMPLES = 50
# Shares of a length, as limits of what is believed: depths that spread by more, sides of a
# marker that differ by more, poses that fit worse.
_MAX_DEPTH_SPREAD = 0.15
_MAX_SIDE_SPREAD = 0.1
_MAX_MISFIT = 0.1
_ORIENTATIONS = 0.05  # weight of orientations beside positions
# A distance shorter than this part of all that the cameras span is mostly noise.
_MIN_SPAN = 0.05


class Hint(NamedTuple):
    """Where metres come from."""

    kind: str
    images: tuple[int, int] = (0, 0)  # of a distance, by their index in the first sequence
    metres: float = 0.0  # of a distance or of a marker's side
    family: str = ""


class Placed(NamedTuple):
    """A view with its camera, and the recording that it is of."""

    view: View
    camera: CameraModel
    recording: Recording


def parse(text: str) -> Hint:
    """Read a hint; ConfigError says how one looks."""
    if text in ("given", "metres", "depth"):
        return Hint(text)
    if match := re.fullmatch(r"distance:(\d+),(\d+)=([\d.eE+-]+)", text):
        first, second = int(match[1]), int(match[2])
        if first != second and (metres := _length(match[3])):
            return Hint("distance", (first, second), metres)
    if match := re.fullmatch(r"marker:(\w+)=([\d.eE+-]+)", text):
        MarkerFinder(match[1])
        if metres := _length(match[2]):
            return Hint("marker", metres=metres, family=match[1])
    raise ConfigError(f"{text!r} says no scale; give {FORMS}")


def check_chosen(hint: Hint, images: Sequence[int]) -> None:
    """RecordingError where the hint names an image that is not built from."""
    for image in hint.images:
        if image not in images:
            near = min(images, key=lambda other: (abs(other - image), other))
            raise RecordingError(
                f"--scale distance: image {image} is not among those that --frames, --every and "
                f"--exclude leave; the nearest of them is {near}"
            )


def check_count(true_poses: int) -> None:
    """RecordingError where so few poses tell nothing of another frame."""
    if true_poses < 2:
        raise RecordingError("--scale given: fewer than two images have a true pose; add some")


def of_distance(hint: Hint, placed: list[Placed]) -> float:
    """Metres a unit of poses by the distance between two cameras."""
    centre = {p.view.image: p.view.T_map_cam[:3, 3] for p in placed if p.view.sequence == 0}
    for image in hint.images:
        if image not in centre:
            raise RecordingError(
                f"--scale distance: image {image} is not among those that have a pose; "
                "choose two that are"
            )
    length = float(np.linalg.norm(centre[hint.images[0]] - centre[hint.images[1]]))
    if length < _MIN_SPAN * _span(placed):
        raise RecordingError(
            f"--scale distance: images {hint.images[0]} and {hint.images[1]} were taken from "
            "nearly the same place; choose two that are far apart"
        )
    return hint.metres / length


def of_marker(hint: Hint, placed: Iterable[Placed]) -> float:
    """Metres a unit of poses by the sides of all markers of a family."""
    images = (
        MarkerImage(p.recording.image(p.view.image), p.camera, p.view.T_map_cam) for p in placed
    )
    sightings = sightings_in(images, hint.family)
    lengths = [sides(corners) for _, corners in squares(sightings)]
    if not lengths:
        raise RecordingError(
            f"--scale marker: no marker of the family {hint.family} is seen from two sides "
            f"({len(sightings)} sightings); check the family, or take images around one"
        )
    every = np.concatenate(lengths)
    side = float(np.median(every))
    if np.ptp(every) > _MAX_SIDE_SPREAD * side:
        raise RecordingError(
            f"--scale marker: sides of markers differ by {100.0 * np.ptp(every) / side:.0f} %; "
            "print all in one size, and lay them flat"
        )
    return hint.metres / side


def of_depth(measured: F64, reckoned: F64) -> float:
    """Units of depth (n,) a unit of poses, in which the same depths (n,) were reckoned."""
    known = (measured > 0.0) & (reckoned > 0.0)
    if np.count_nonzero(known) < _MIN_SAMPLES:
        raise RecordingError(
            f"--scale depth: only {np.count_nonzero(known)} points have a depth; use another hint"
        )
    ratio = np.log(measured[known] / reckoned[known])
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - middle)))
    if spread > _MAX_DEPTH_SPREAD:
        raise RecordingError(
            f"--scale depth: depth and images disagree by {100.0 * spread:.0f} %; "
            "is the depth that of the colour camera?"
        )
    return math.exp(middle)


def onto_poses(poses: list[Mat4], truth: list[Mat4]) -> Sim3:
    """Similarity that takes poses (n) to the true ones (n): also for cameras on a line.

    Positions tell the rotation best; orientations say what positions on a line leave open.
    """
    check_count(len(poses))
    here, there = (np.array([T[:3, 3] for T in side]) for side in (poses, truth))
    here_mean, there_mean = here.mean(axis=0), there.mean(axis=0)
    here, there = here - here_mean, there - there_mean
    turns = [T[:3, :3] @ P[:3, :3].T for T, P in zip(truth, poses, strict=True)]
    sizes = max(float(np.linalg.norm(here) * np.linalg.norm(there)), 1e-300)
    R = so3.normalise(there.T @ here / sizes + _ORIENTATIONS * np.mean(turns, axis=0))
    here = here @ R.T
    s = float(np.sum(there * here)) / max(float(np.sum(here**2)), 1e-300)
    size = math.sqrt(float(np.mean(np.sum(there**2, axis=1))))
    rms = math.sqrt(float(np.mean(np.sum((there - s * here) ** 2, axis=1))))
    if not s > 0.0 or rms > _MAX_MISFIT * size:
        raise RecordingError(
            f"--scale given: the given poses do not fit the images (they move {size:.3g} m, and "
            f"are off by {rms:.3g} m); mend them, or use another hint"
        )
    return Sim3(s, R, there_mean - s * (R @ here_mean))


def _length(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 1e-4 <= value <= 1e6 else None


def _span(placed: list[Placed]) -> float:
    centres = np.array([p.view.T_map_cam[:3, 3] for p in placed])
    return float(np.linalg.norm(np.ptp(centres, axis=0)))
