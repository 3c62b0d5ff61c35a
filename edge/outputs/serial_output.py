# SPDX-License-Identifier: Apache-2.0
"""Puts the configured protocol, frames and rate together for one map."""

import math

import numpy as np

from edge.config.serial import SerialConfig
from edge.outputs.autopilot import Autopilot
from edge.outputs.binary_frames import BinaryFrames
from edge.outputs.frames import BodyFrames, frd_from_level, require_level_metres
from edge.outputs.sentences import Sentences
from edge.outputs.serial_stream import SerialProtocol, SerialStream


def make_stream(
    config: SerialConfig, *, metric: bool, T_local_map: list[list[float]] | None, map_name: str
) -> SerialStream:
    """The stream of `config` for the map whose manifest holds `metric` and `T_local_map`.

    ConfigError names what mends a map that MAVLink cannot be fed from. The other protocols
    take any map and say what it lacks.
    """
    protocol: SerialProtocol
    if config.protocol == "mavlink":
        T_level_map = require_level_metres(
            metric=metric, T_local_map=T_local_map, map_name=map_name
        )
        degrees = config.map_heading_deg
        heading_rad = None if degrees is None else math.radians(degrees)
        T_world_map = frd_from_level(heading_rad) @ T_level_map
        protocol = Autopilot(config)
    else:
        T_world_map = np.eye(4) if T_local_map is None else np.array(T_local_map, np.float64)
        level = T_local_map is not None
        protocol = (
            BinaryFrames(metric=metric, level=level)
            if config.protocol == "binary"
            else Sentences(metric=metric, level=level)
        )
    frames = BodyFrames(np.array(config.T_body_cam, np.float64), T_world_map)
    return SerialStream(protocol, frames, config.rate_hz)
