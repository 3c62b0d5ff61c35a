# SPDX-License-Identifier: Apache-2.0
"""What passes between the daemon and the process that looks for changes.

Both are of one installation and neither reads anything else from there, so objects go as they are.
"""

from typing import NamedTuple

from edge.config.changes import ChangesConfig
from edge.geometry.camera import CameraModel
from edge.tiles.manifest import Manifest
from edge.types import ChangeEvent


class Order(NamedTuple):
    """What the process is to do."""

    map_folder: str
    manifest: Manifest  # of the map that is meant: its folder may have been exchanged since
    resident_bytes: int
    camera: CameraModel
    names: tuple[str, ...] | None  # classes of the model that looks; None: there is no model
    config: ChangesConfig
    nice: int
    cpus: tuple[int, ...]


class Ready(NamedTuple):
    """The map is open."""


class Found(NamedTuple):
    """What has become sure with a look."""

    events: list[ChangeEvent]


class Failed(NamedTuple):
    """Why there is nothing."""

    reason: str
