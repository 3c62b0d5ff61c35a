# SPDX-License-Identifier: Apache-2.0
"""A V4L2 camera on a scripted kernel, opened and read."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from edge.cameras import v4l2_abi as abi
from edge.cameras.v4l2 import V4l2Camera
from edge.config.v4l2 import V4l2Config
from edge.errors import CameraLost
from edge.geometry.camera import CameraModel
from edge.types import Frame
from tests.edge.cameras.device_tree import MadeTree
from tests.edge.cameras.scripted_kernel import (
    Control,
    ScriptedKernel,
)

MODEL = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)
EXPOSURE = {
    abi.CID_EXPOSURE_AUTO: Control(0, 3, 3, allowed=(1, 3)),
    abi.CID_EXPOSURE_ABSOLUTE: Control(1, 5000, 157),
}


def plugged(folder: Path) -> MadeTree:
    """A machine with one camera."""
    made = MadeTree(folder)
    made.plug("1.2", 0, "A1")
    return made


def open_camera(
    kernel: ScriptedKernel, made: MadeTree, *, colour: bool = False, **settings: object
) -> V4l2Camera:
    chosen = {"serial": "A1", "width": 64, "height": 48} | settings
    config = msgspec.convert(chosen, V4l2Config)
    return V4l2Camera(config, MODEL, kernel, made.tree, colour=colour)


def take(camera: V4l2Camera, count: int) -> list[Frame]:
    return list(itertools.islice(camera, count))


def until_lost(camera: V4l2Camera) -> Iterator[Frame]:
    """Frames up to CameraLost, which must come."""
    with pytest.raises(CameraLost):
        yield from camera
