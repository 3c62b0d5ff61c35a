# SPDX-License-Identifier: Apache-2.0
"""What a frame is found by: the map, markers, or both."""

import msgspec
import numpy as np

from edge.config import Config
from edge.config.markers import MarkerPlace, MarkersConfig
from edge.errors import ConfigError
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.lines.work import Clock, no_clock
from edge.relocalise.marker_fixes import MarkerFixes, with_metres
from edge.relocalise.relocaliser import Relocaliser
from edge.runtime.learned import make_relocaliser
from edge.runtime.search import RelocaliseStage
from edge.tiles.reader import Map
from edge.types import Fix, Query


class MarkedSearch:
    """Looks for markers first: those of known place need no map. Owned by one thread."""

    def __init__(self, markers: MarkerFixes, relocaliser: Relocaliser | None) -> None:
        self._markers, self._relocaliser = markers, relocaliser

    def step(self, query: Query) -> Fix:
        """The attempt to find `query`."""
        fix, scale = self._markers.fix(query)
        if fix is not None:
            return fix
        if self._relocaliser is not None:
            return with_metres(self._relocaliser.step(query), scale)
        frame = query.frame
        return Fix(frame.index, frame.t_ns, query.odom_id, query.T_odom_cam, False, "no marker")


def make_finder(
    config: Config, camera: CameraModel, map_: Map | None, clock: Clock = no_clock
) -> RelocaliseStage | None:
    """What finds frames, None where there is neither map nor marker to find them by.

    `camera` is the one by which the map, if there is one, reads our images; `clock` tells what
    parts of the search cost.
    """
    relocaliser = None
    if map_ is not None:
        resident = config.map.resident_bytes
        relocaliser = make_relocaliser(map_, camera, config.relocalise, resident, clock)
    markers = _with_those_of(map_, config.markers)
    if not markers.family:
        return relocaliser
    if map_ is not None and not map_.manifest.metric:
        raise ConfigError(
            f"markers: are in metres, but {map_.folder} is not; build it with --scale, or leave "
            "markers.family empty"
        )
    return MarkedSearch(MarkerFixes(camera, markers, has_map=map_ is not None), relocaliser)


def _with_those_of(map_: Map | None, config: MarkersConfig) -> MarkersConfig:
    """The settings with the map's markers among those known; where both know one, the settings'."""
    if map_ is None or not config.in_map or not map_.manifest.metric:
        return config
    stored = map_.manifest.markers
    family = config.family or (stored[0].family if stored else "")
    listed = {place.number for place in config.known}
    places = []
    for marker in stored:
        if marker.family.upper() == family.upper() and marker.number not in listed:
            x, y, z, *turn = se3.to_tum(np.array(marker.T_map_marker)).tolist()
            qx, qy, qz, qw = turn
            place = MarkerPlace(
                number=marker.number,
                side_m=marker.side,
                position_m=(x, y, z),
                rotation_xyzw=(qx, qy, qz, qw),
            )
            places.append(place)
    return msgspec.structs.replace(config, family=family, known=(*config.known, *places))
