# SPDX-License-Identifier: Apache-2.0
"""Where the daemon's frames come from."""

from typing import Literal

from msgspec import Struct, field

from edge.config.oak import OakConfig
from edge.config.v4l2 import V4l2Config


class CameraConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The camera of `mapvo run` and `mapvo record`."""

    # `v4l2`: USB and most others. `oak`: Luxonis devices (needs the extra oak). `recording`: plays
    # one at its own rate, to try things without a camera.
    source: Literal["v4l2", "oak", "recording"] = "recording"
    # camera.toml that `mapvo calibrate` wrote; an OAK brings its own, which this one overrides, and
    # so does a recording.
    calibration: str = ""
    # Folder or file of the recording.
    recording: str = ""
    # `forth_and_back` never jumps; `again` jumps at its seam, to try loss and recovery.
    play: Literal["once", "again", "forth_and_back"] = "forth_and_back"
    v4l2: V4l2Config = field(default_factory=V4l2Config)
    oak: OakConfig = field(default_factory=OakConfig)
