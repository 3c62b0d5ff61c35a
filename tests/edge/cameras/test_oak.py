# SPDX-License-Identifier: Apache-2.0
import json
import os
import sys
import threading
import time
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from edge.cameras.live import LiveSource
from edge.cameras.oak import OakCamera, device_calibration, oak_opener
from edge.cameras.oak_link import ImageSlots, Opened, make_memory
from edge.config.loader import load_struct
from edge.config.oak import OakConfig
from edge.errors import CameraLost, CameraRefused, ConfigError
from edge.geometry.camera import CameraModel
from edge.types import Frame
from tests.edge.cameras.oak_stand_in import PERIOD_NS, picture, picture_with_colour

OPEN = ["open", {"device_id": "18443010", "product": "OAK-D", "usb_speed": "SUPER"}]
SIZE = {"width": 64, "height": 48}


def _open(*script: list[object], colour: bool = False, **settings: object) -> OakCamera:
    config = msgspec.convert(SIZE | settings, OakConfig)
    child = (sys.executable, "-m", "tests.edge.cameras.oak_stand_in", json.dumps(script))
    return OakCamera(config, child=child, colour=colour)


def _play(camera: OakCamera, error: type[Exception], match: str) -> list[Frame]:
    """Frames until the error that must come; afterwards nothing of the child is left."""
    frames: list[Frame] = []
    with pytest.raises(error, match=match):
        frames.extend(camera)  # extend keeps what came before the error
    camera.close()
    assert camera._process.returncode is not None
    return frames


def _descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208  # no paths are wanted


def test_images_come_through_shared_memory_with_their_times() -> None:
    before = _descriptors()
    camera = _open(OPEN, *(["image", n] for n in range(4)), ["gone", "was unplugged"])
    assert camera.identity == "oak:18443010 CAM_B"
    frames = _play(camera, CameraLost, "was unplugged")
    assert [frame.index for frame in frames] == list(range(4))
    for frame in frames:
        np.testing.assert_array_equal(frame.image, picture(frame.index, 64, 48))
        assert frame.t_ns == (frame.index + 1) * PERIOD_NS
        assert frame.exposure_ns == 5_000_000
        assert frame.gain_db == pytest.approx(6.02, abs=0.01)  # ISO 200
        assert not frame.image.flags.writeable
    assert _descriptors() <= before


def test_the_colour_sensor_sends_colour_that_is_made_when_asked_for() -> None:
    steps = [["image", n] for n in range(2)]
    camera = _open(OPEN, *steps, ["gone", "end"], colour=True, socket="CAM_A")
    for frame in _play(camera, CameraLost, "end"):
        np.testing.assert_array_equal(frame.image, picture(frame.index, 64, 48))
        stored = picture_with_colour(frame.index, 64, 48)
        assert frame.colour is not None
        np.testing.assert_array_equal(frame.colour(), cv2.cvtColor(stored, cv2.COLOR_YUV2RGB_NV12))
    grey = _open(OPEN, ["image", 0], ["gone", "end"], colour=True)  # CAM_B is a grey one
    (frame,) = _play(grey, CameraLost, "end")
    assert frame.colour is None
    np.testing.assert_array_equal(frame.image, picture(0, 64, 48))


def test_gaps_and_images_that_were_overwritten_are_counted() -> None:
    steps = [["image", 0], ["image", 4], ["late", 5], ["image", 6], ["gone", "end"]]
    camera = _open(OPEN, *steps)
    frames = _play(camera, CameraLost, "end")
    assert [frame.index for frame in frames] == [0, 4, 6]
    assert camera.dropped == 3 + 1


def test_images_from_before_anybody_asked_are_no_losses() -> None:
    camera = _open(OPEN, *(["image", n] for n in range(40)), ["gone", "end"])
    while camera._process.poll() is None:  # until it has sent all there is
        time.sleep(0.01)
    frames = _play(camera, CameraLost, "end")
    assert [frame.index for frame in frames] == [36, 37, 38, 39]
    assert camera.dropped == 0


@pytest.mark.parametrize(
    ("step", "error", "match"),
    [
        (["refuse", "needs depthai"], CameraRefused, "OAK: needs depthai"),
        (["die", 7], CameraLost, r"its process ended \(status 7\)"),
        (["nonsense"], CameraLost, "sends nonsense"),
    ],
)
def test_however_the_child_ends_it_is_said(
    step: list[object], error: type[Exception], match: str
) -> None:
    assert len(_play(_open(OPEN, ["image", 0], step), error, match)) == 1
    before = _descriptors()
    with pytest.raises(error, match=match):
        _open(step)
    assert _descriptors() <= before


@pytest.mark.slow
def test_a_child_that_hangs_counts_as_a_lost_camera_and_is_ended() -> None:
    camera = _open(OPEN, ["image", 0], ["sleep"], stall_s=3.0)
    assert len(_play(camera, CameraLost, "gave no image for 3 s")) == 1
    with pytest.raises(CameraLost, match="did not open within 1 s"):
        _open(["sleep"], open_timeout_s=1.0)


def test_a_device_that_hangs_while_it_is_opened_holds_up_no_end() -> None:
    config = msgspec.convert(SIZE | {"open_timeout_s": 20.0}, OakConfig)
    child = (sys.executable, "-m", "tests.edge.cameras.oak_stand_in", json.dumps([["sleep"]]))
    stopping, opening = threading.Event(), threading.Event()

    def open_camera() -> OakCamera:
        opening.set()
        with pytest.raises(CameraLost, match="was not waited for") as lost:
            OakCamera(config, child=child, go_on=lambda: not stopping.is_set())
        raise lost.value

    model = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)
    source = LiveSource(model, 30.0, "", open_camera, stopping=stopping)
    stopper = threading.Thread(target=lambda: (opening.wait(), source.stop()))
    stopper.start()
    assert list(source) == []
    assert source.losses == 0
    stopper.join()
    source.close()


def test_another_device_than_the_calibrations_is_refused() -> None:
    camera = _open(OPEN, ["sleep"])
    opener = oak_opener(camera._config, "oak:other CAM_B", "camera.toml", camera)
    with pytest.raises(CameraRefused, match="of oak:other CAM_B, but the camera is oak:18443010"):
        opener()
    assert camera._process.returncode is not None


@pytest.mark.slow
def test_a_device_that_comes_back_twice_goes_on() -> None:
    scripts = [
        [OPEN, ["image", 0], ["image", 1], ["gone", "was unplugged"]],
        [["gone", "no device"]],
        [OPEN, ["image", 0], ["die", 9]],
        [OPEN, ["image", 0], ["image", 1], ["sleep"]],
    ]
    opened: list[OakCamera] = []

    def open_device(config: OakConfig) -> OakCamera:
        opened.append(_open(*scripts.pop(0)))
        return opened[-1]

    config = msgspec.convert(SIZE, OakConfig)
    opener = oak_opener(config, "oak:18443010 CAM_B", "camera.toml", open_device=open_device)
    model = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)
    source = LiveSource(model, 30.0, "oak:18443010 CAM_B", opener)
    frames = []
    for frame in source:
        frames.append(frame)
        if len(frames) == 5:
            source.stop()
    source.close()
    assert [frame.index for frame in frames] == list(range(5))
    assert source.losses == 2
    assert [camera._process.returncode is not None for camera in opened] == [True] * 3


def test_a_default_calibration_is_used_only_if_that_is_wished() -> None:
    K = [[400.0, 0.0, 31.0], [0.0, 401.0, 24.0], [0.0, 0.0, 1.0]]
    opened = Opened("1", "OAK", "SUPER", "Perspective", K, [0.0] * 14, is_default=True)
    config = msgspec.convert(SIZE, OakConfig)
    with pytest.raises(CameraRefused, match="allow_default_calibration"):
        device_calibration(opened, config)
    allowed = msgspec.structs.replace(config, allow_default_calibration=True)
    assert device_calibration(opened, allowed).fy == 401.0


def test_memory_is_written_and_read_by_marks() -> None:
    fd = make_memory()
    slots = ImageSlots(fd, 64, 48)
    first = picture(1, 64, 48)
    slot = slots.write(1, first)
    read = slots.read(slot, 1)
    assert read is not None
    np.testing.assert_array_equal(read, first)
    slots.write(9, picture(9, 64, 48))
    assert slots.read(slot, 1) is None
    slots.close()
    os.close(fd)


def test_an_exposure_longer_than_a_frame_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text("exposure_us = 40000\n")
    with pytest.raises(ConfigError, match="longer than a frame at 30 Hz: set 33333 or less"):
        load_struct(path, OakConfig)
