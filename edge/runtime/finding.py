# SPDX-License-Identifier: Apache-2.0
"""What a frame is found by: the map, markers, or both."""

from edge.config import Config
from edge.errors import ConfigError
from edge.geometry.camera import CameraModel
from edge.relocalise.marker_fixes import MarkerFixes, with_metres
from edge.relocalise.relocaliser import Relocaliser
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


def make_finder(config: Config, camera: CameraModel, map_: Map | None) -> RelocaliseStage | None:
    """What finds frames, None where there is neither map nor marker to find them by.

    `camera` is the one by which the map, if there is one, reads our images.
    """
    relocaliser = None if map_ is None else Relocaliser(map_, camera, config.relocalise)
    if not config.markers.family:
        return relocaliser
    if map_ is not None and not map_.manifest.metric:
        raise ConfigError(
            f"markers: are in metres, but {map_.folder} is not; build it with --scale, or leave "
            "markers.family empty"
        )
    return MarkedSearch(MarkerFixes(camera, config.markers, has_map=map_ is not None), relocaliser)
