# SPDX-License-Identifier: Apache-2.0
"""All settings of the device: one frozen structure, read from one TOML file."""

from pathlib import Path

from msgspec import Struct, field

from edge.config.camera import CameraConfig
from edge.config.changes import ChangesConfig
from edge.config.loader import load_struct
from edge.config.map import MapConfig
from edge.config.markers import MarkersConfig
from edge.config.odometry import OdometryConfig
from edge.config.outputs import OutputsConfig
from edge.config.recorder import RecorderConfig
from edge.config.registration import RegistrationConfig
from edge.config.relocalise import RelocaliseConfig
from edge.config.runtime import RuntimeConfig
from edge.config.segmenter import SegmenterConfig
from edge.config.tiles import TilesConfig


class Config(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One table for each stage; what a file does not name keeps its default."""

    camera: CameraConfig = field(default_factory=CameraConfig)
    map: MapConfig = field(default_factory=MapConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    relocalise: RelocaliseConfig = field(default_factory=RelocaliseConfig)
    markers: MarkersConfig = field(default_factory=MarkersConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    segmenter: SegmenterConfig = field(default_factory=SegmenterConfig)
    changes: ChangesConfig = field(default_factory=ChangesConfig)
    runtime: RuntimeConfig = field(default_factory=RuntimeConfig)
    outputs: OutputsConfig = field(default_factory=OutputsConfig)
    recorder: RecorderConfig = field(default_factory=RecorderConfig)
    tiles: TilesConfig = field(default_factory=TilesConfig)


def load_config(path: Path | None) -> Config:
    """Return the settings of the file at `path`, or all defaults without one."""
    return Config() if path is None else load_struct(path, Config)
