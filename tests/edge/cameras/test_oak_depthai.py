# SPDX-License-Identifier: Apache-2.0
"""With depthai itself (extra `oak`): its host-only pipeline plays what a device would send."""

import time
from datetime import timedelta
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from edge.cameras.oak import OakCamera
from edge.cameras.oak_calibration import camera_from_device
from edge.cameras.oak_child import read_lens, set_exposure
from edge.cameras.oak_link import Replay
from edge.config.oak import OakConfig
from edge.errors import CameraLost
from edge.types import Frame

pytestmark = pytest.mark.slow

WIDTH, HEIGHT, COUNT = 320, 200, 12
CONFIG = msgspec.convert({"width": WIDTH, "height": HEIGHT, "stall_s": 5.0}, OakConfig)


@pytest.fixture(scope="module")
def dai() -> Any:
    return pytest.importorskip("depthai", reason="needs the extra oak")


def _level(index: int) -> int:
    """Grey of a whole image, which survives any compression."""
    return 20 + 15 * index


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("oak") / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (WIDTH, HEIGHT))
    for index in range(COUNT):
        writer.write(np.full((HEIGHT, WIDTH, 3), _level(index), np.uint8))
    writer.release()
    return path


def _play(camera: OakCamera) -> list[Frame]:
    """All frames up to the end, which is a lost camera."""
    frames: list[Frame] = []
    with pytest.raises(CameraLost, match="was unplugged or has stopped"):
        frames.extend(camera)  # extend keeps what came before the error
    camera.close()
    return frames


def test_a_host_only_pipeline_gives_grey_images_on_our_clock(dai: Any, video: Path) -> None:
    began_ns = time.monotonic_ns()
    frames = _play(OakCamera(CONFIG, Replay(str(video))))
    assert len(frames) >= 4
    for frame in frames:
        assert frame.image.shape == (HEIGHT, WIDTH)
        assert frame.image.mean() == pytest.approx(_level(frame.index), abs=4)  # [grey] of MJPG
    times_ns = [frame.t_ns for frame in frames]
    assert times_ns == sorted(times_ns)
    assert began_ns < times_ns[0] < times_ns[-1] < time.monotonic_ns()


def test_the_colour_sensor_gives_colour_where_it_is_asked_for(dai: Any, tmp_path: Path) -> None:
    path, bgr = tmp_path / "blue.avi", (200, 90, 40)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (WIDTH, HEIGHT))
    for _ in range(COUNT):
        writer.write(np.full((HEIGHT, WIDTH, 3), bgr, np.uint8))
    writer.release()
    config = msgspec.structs.replace(CONFIG, socket="CAM_A")

    frames = _play(OakCamera(config, Replay(str(path)), colour=True))

    grey = cv2.cvtColor(np.full((1, 1, 3), bgr, np.uint8), cv2.COLOR_BGR2GRAY)[0, 0]
    assert len(frames) >= 4
    for frame in frames:
        assert frame.colour is not None
        colour = frame.colour()
        assert colour is not None
        assert colour.shape == (HEIGHT, WIDTH, 3)
        np.testing.assert_allclose(colour.reshape(-1, 3).mean(axis=0), bgr[::-1], atol=12)
        assert frame.image.shape == (HEIGHT, WIDTH)
        assert frame.image.mean() == pytest.approx(float(grey), abs=20)  # of limited range


def _record_with_metadata(dai: Any, folder: Path) -> Replay:
    """Frames exposed for 4 ms at ISO 800, numbered from 100 on, as depthai records them."""

    class Source(dai.node.ThreadedHostNode):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.out = self.createOutput()

        def run(self) -> None:
            for index in range(COUNT):
                frame = dai.ImgFrame()
                image = np.full((HEIGHT, WIDTH, 3), _level(index), np.uint8)
                frame.setCvFrame(image, dai.ImgFrame.Type.BGR888i)
                frame.cam.exposureTimeUs, frame.cam.sensitivityIso = 4000, 800
                frame.setSequenceNum(100 + index)
                frame.setTimestamp(timedelta(seconds=1000, milliseconds=33 * index))
                self.out.send(frame)
                time.sleep(0.03)
            self.done = True

    video, metadata = str(folder / "video.avi"), str(folder / "metadata.mcap")
    with dai.Pipeline(createImplicitDevice=False) as pipeline:
        source = pipeline.create(Source)
        recorder = pipeline.create(dai.node.RecordVideo)
        recorder.setRecordVideoFile(video)
        recorder.setRecordMetadataFile(metadata)
        recorder.setFps(30)
        source.out.link(recorder.input)
        pipeline.start()
        while not getattr(source, "done", False):
            time.sleep(0.1)
        time.sleep(0.5)  # the last ones are on their way
        pipeline.stop()
        pipeline.wait()
    return Replay(video, metadata)


def test_times_are_those_of_the_exposures_middle(dai: Any, tmp_path: Path) -> None:
    frames = _play(OakCamera(CONFIG, _record_with_metadata(dai, tmp_path)))
    assert len(frames) >= 4
    for frame in frames:
        index = frame.index - 100
        assert 0 <= index < COUNT
        stamp_ns = 1_000_000_000_000 + 33_000_000 * index  # the exposure's end
        assert frame.t_ns == stamp_ns - 2_000_000
        assert frame.exposure_ns == 4_000_000
        assert frame.gain_db == pytest.approx(18.06, abs=0.01)  # ISO 800
        assert frame.image.mean() == pytest.approx(_level(index), abs=4)


def test_where_no_device_is_it_says_so(dai: Any) -> None:
    with pytest.raises(CameraLost, match="no device 123"):
        OakCamera(msgspec.structs.replace(CONFIG, device_id="123"))


def test_exposure_settings_are_what_depthai_takes(dai: Any) -> None:
    fixed = dai.CameraControl()
    set_exposure(fixed, msgspec.structs.replace(CONFIG, exposure_us=4000, iso=800))
    assert (fixed.getExposureTime(), fixed.getSensitivity()) == (timedelta(microseconds=4000), 800)
    set_exposure(dai.CameraControl(), CONFIG)


def test_a_factory_calibration_is_read_for_the_images_size(dai: Any) -> None:
    handler = dai.CalibrationHandler()
    socket = dai.CameraBoardSocket.CAM_B
    K = [[800.0, 0.0, 630.0], [0.0, 801.0, 410.0], [0.0, 0.0, 1.0]]
    handler.setCameraIntrinsics(socket, K, 1280, 800)
    handler.setDistortionCoefficients(socket, [0.1, -0.2, 0.001, 0.002, 0.3, *[0.0] * 9])
    camera = camera_from_device(*read_lens(handler, socket, 640, 400), 640, 400)
    assert camera.distortion_model == "radtan"
    assert camera.distortion == pytest.approx((0.1, -0.2, 0.001, 0.002, 0.3))
    assert (camera.fx, camera.cx) == pytest.approx((400.0, 315.0), abs=0.5)


def test_what_the_device_path_asks_for_exists(dai: Any) -> None:
    for owner, names in {
        dai.Device: (
            *("getDeviceById", "getConnectedCameras", "setMaxReconnectionAttempts"),
            *("readCalibration", "readCalibration2", "getDeviceId", "getProductName"),
            *("getDeviceName", "getUsbSpeed", "__enter__"),
        ),
        dai.Pipeline: ("create", "start", "isRunning", "__enter__"),
        dai.node.Camera: ("build", "initialControl", "requestOutput"),
        dai.ImgFrame: (
            *("getFrame", "getTimestamp", "getSequenceNum", "getExposureTime", "getSensitivity"),
        ),
    }.items():
        for name in names:
            assert hasattr(owner, name), name
    sockets = dai.CameraBoardSocket.__members__
    assert set(sockets) >= {"CAM_A", "CAM_B", "CAM_C", "CAM_D"}
    assert "HIGH" in dai.UsbSpeed.__members__
    assert set(dai.CameraModel.__members__) >= {"Perspective", "Fisheye"}
