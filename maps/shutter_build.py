# SPDX-License-Identifier: Apache-2.0
"""A build's features put where all rows would have seen them at once, and measured again."""

from typing import TypeAlias

import numpy as np

from edge.cameras.recording import open_recording
from edge.odometry.motion import Rates
from edge.types import F64
from maps.describe import Description
from maps.lens import sightings_of
from maps.lens_build import Measure, Measured, quick
from maps.settings import BuildSettings
from maps.shutter import at_once, rates_at, readout_of
from maps.views import View, ViewSet

# By recording and camera: one clock, one shutter.
Group: TypeAlias = tuple[int, int]
Readouts: TypeAlias = dict[Group, float]

# Poses, and what their unit comes from: where both are as the recording says.
_TOLD_BY_RECORDINGS = {("given", "given"), ("given", "none")}


def with_rows_at_once(measured: Measured, measure: Measure, settings: BuildSettings) -> Measured:
    """Measure again without what a rolling shutter did to features, where it clearly did.

    `measure` matches and fuses. Rows of fast turns miss their matches at first, so the readout is
    found once more with the help of the first estimate.
    """
    origin = measured.chosen.origin
    # What structure from motion finds has taken the motion of rows for one of its own.
    if settings.shutter == "global" or (origin.poses, origin.scale) not in _TOLD_BY_RECORDINGS:
        return measured
    moving = _moving(measured.chosen)
    readouts = _readouts(measured, moving)
    if not any(readouts.values()):
        return measured
    rough = measure(measured.chosen, _at_once(measured, moving, readouts), quick(settings))
    rest = _readouts(rough, moving)
    readouts = {g: readout_s + rest[g] for g, readout_s in readouts.items() if readout_s}
    chosen = measured.chosen._replace(readouts=readouts)
    return measure(chosen, _at_once(measured, moving, readouts), settings)


def _moving(chosen: ViewSet) -> list[Rates | None]:
    """How the camera moved at each view."""
    recordings = [open_recording(root) for root in chosen.roots]
    truths = [recording.groundtruth for recording in recordings]
    found: list[Rates | None] = []
    for view in chosen.views:
        truth = truths[view.sequence]
        found.append(None if truth is None else rates_at(truth, view.t_ns))
    return found


def _group(view: View) -> Group:
    return view.sequence, view.camera


def _readouts(measured: Measured, moving: list[Rates | None]) -> Readouts:
    chosen = measured.chosen
    poses = [view.T_map_cam for view in chosen.views]
    told = np.array([rates is not None for rates in moving])
    found = {}
    for group in sorted({_group(view) for view in chosen.views}):
        own = np.array([_group(view) == group for view in chosen.views]) & told
        camera = chosen.cameras[group[1]]
        sightings = sightings_of(
            own, camera, poses, measured.descriptions, measured.sides, measured.points
        )
        found[group] = readout_of(sightings, moving, camera)
    return found


def _at_once(
    measured: Measured, moving: list[Rates | None], readouts: Readouts
) -> list[Description]:
    chosen, depths = measured.chosen, _depths(measured)
    result = []
    for view, description, here, depth in zip(
        chosen.views, measured.descriptions, moving, depths, strict=True
    ):
        readout_s = readouts.get(_group(view), 0.0)
        if here is not None and readout_s:
            camera = chosen.cameras[view.camera]
            description = at_once(description, camera, here, readout_s, depth)
        result.append(description)
    return result


def _depths(measured: Measured) -> list[F64]:
    """Depth of each feature: of its point, or as given, or the median of its view."""
    points = measured.points
    owner = np.repeat(np.arange(len(points.xyz)), np.diff(points.offsets))
    depths = []
    for k, (view, description) in enumerate(
        zip(measured.chosen.views, measured.descriptions, strict=True)
    ):
        depth = description.depth.copy()
        rows = points.view == k
        axis, centre = view.T_map_cam[:3, 2], view.T_map_cam[:3, 3]
        depth[points.feature[rows]] = (points.xyz[owner[rows]] - centre) @ axis
        known = depth > 0.0
        depth[~known] = np.median(depth[known]) if known.any() else np.inf
        depths.append(depth)
    return depths
