# SPDX-License-Identifier: Apache-2.0
"""A build's cameras refined by what the build itself measures, and measured again with them."""

import logging
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import msgspec
import numpy as np

from edge.geometry.camera import CameraModel
from maps.describe import Description
from maps.fusion import Points
from maps.lens import Lens, described_through, refined, refitted, sightings_of
from maps.lens_fit import Sightings
from maps.matching import MatchSide
from maps.settings import BuildSettings
from maps.views import ViewSet

log = logging.getLogger(__name__)

_FEWER_VIEWS = 4  # are matched with each for a first estimate


class Measured(NamedTuple):
    """What a build knows after matching and fusing."""

    chosen: ViewSet
    descriptions: list[Description]
    sides: list[MatchSide]
    points: Points


Measure: TypeAlias = Callable[[ViewSet, list[Description], BuildSettings], Measured]


def quick(settings: BuildSettings) -> BuildSettings:
    """Settings to measure with where the measurement is a step to the next one."""
    fewer = min(settings.similar_views, _FEWER_VIEWS)
    return msgspec.structs.replace(settings, similar_views=fewer)


def with_refined_lenses(
    measured: Measured, measure: Measure, settings: BuildSettings
) -> tuple[Measured, dict[int, CameraModel]]:
    """Measure again with better cameras where there are some; return the replaced ones, too.

    `measure` matches and fuses. The tracks of the given lens miss what it bends most, so the
    lens is fitted once more to tracks of the first estimate.
    """
    given = measured.chosen.cameras
    # The lens of one camera of a calibrated pair cannot be changed alone.
    if settings.lens == "given" or settings.depth == "stereo" or len(measured.points.xyz) == 0:
        return measured, {}
    found = {c: refined(_sightings(measured, c), camera) for c, camera in enumerate(given)}
    lenses = {c: lens for c, lens in found.items() if lens is not None}
    if not lenses:
        return measured, {}
    rough = measure(*_through(measured, lenses), quick(settings))
    lenses = {c: refitted(_sightings(rough, c), given[c], lens) for c, lens in lenses.items()}
    for lens in lenses.values():
        log.info(
            "event=lens_refined change_px=%.2f gain=%.3f distortion=%s",
            lens.change_px,
            lens.gain,
            lens.camera.distortion,
        )
    return measure(*_through(measured, lenses), settings), {c: given[c] for c in lenses}


def _sightings(measured: Measured, camera: int) -> Sightings:
    views = measured.chosen.views
    own = np.array([view.camera == camera for view in views])
    poses = [view.T_map_cam for view in views]
    given = measured.chosen.cameras[camera]
    return sightings_of(own, given, poses, measured.descriptions, measured.sides, measured.points)


def _through(measured: Measured, lenses: dict[int, Lens]) -> tuple[ViewSet, list[Description]]:
    """Views and descriptions with the cameras of `lenses` in the place of those given."""
    chosen = measured.chosen
    cameras = list(chosen.cameras)
    for camera, lens in lenses.items():
        cameras[camera] = lens.camera
    descriptions = [
        described
        if view.camera not in lenses
        else described_through(described, chosen.cameras[view.camera], cameras[view.camera])
        for view, described in zip(chosen.views, measured.descriptions, strict=True)
    ]
    return chosen._replace(cameras=cameras), descriptions
