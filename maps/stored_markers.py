# SPDX-License-Identifier: Apache-2.0
"""Markers that the images of a build show, to be stored with its map."""

import logging

import msgspec
import numpy as np

from edge.cameras.recording import open_recording
from edge.runtime.progress import progress
from edge.tiles.manifest import MarkerEntry
from maps.markers import MarkerImage, pose_of, sides, sightings_in, squares
from maps.views import ViewSet

log = logging.getLogger(__name__)

_MAX_SPREAD = 0.05  # of a marker's sides: more is a bent sheet, or two markers of one number


def find_markers(chosen: ViewSet, family: str) -> list[MarkerEntry]:
    """The markers of a family that are seen from two sides, with their places in the map."""
    recordings = [open_recording(root) for root in chosen.roots]
    images = (
        MarkerImage(
            recordings[view.sequence].image(view.image), chosen.cameras[view.camera], view.T_map_cam
        )
        for view in progress(chosen.views, len(chosen.views), "markers")
    )
    entries = []
    for number, corners in squares(sightings_in(images, family)):
        lengths = sides(corners)
        if np.ptp(lengths) > _MAX_SPREAD * float(np.mean(lengths)):
            log.warning("marker %d left out: its sides differ; lay it flat, once", number)
            continue
        entry = {
            "family": family,
            "number": number,
            "side": float(np.mean(lengths)),
            "T_map_marker": pose_of(corners, on_wall=False).tolist(),
        }
        entries.append(msgspec.convert(entry, MarkerEntry))
    return entries
