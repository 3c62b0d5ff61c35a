# SPDX-License-Identifier: Apache-2.0
"""The daemon's loop with a scripted camera and scripted stages: whatever happens, it goes on."""

import gc
import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.cameras.live import open_live
from edge.config import Config
from edge.config.camera import CameraConfig
from edge.config.ladder import LadderConfig
from edge.config.odometry import OdometryConfig
from edge.config.outputs import OutputsConfig, ZmqConfig
from edge.config.registration import RegistrationConfig
from edge.config.runtime import RuntimeConfig
from edge.errors import TileError
from edge.geometry.camera_text import camera_toml
from edge.outputs.control import ResetCommand
from edge.outputs.report import FrameReport
from edge.outputs.wire import StatusMessage
from edge.outputs.zmq_pub import ZmqPublisher
from edge.registration.registration import Registration
from edge.runtime.daemon import Daemon
from edge.runtime.keyframe_worker import KeyframeTimes
from edge.runtime.live import OpenedMap
from edge.runtime.live_player import LivePlayer
from edge.runtime.map_switch import MapSwitch, SwapRefused
from edge.runtime.pipeline import Pipeline
from edge.runtime.search import DelayedSearch, NoSearch, Search
from edge.runtime.warm_up import MAP_FOLDER
from edge.tiles.reader import Map, open_map
from edge.types import Frame, Mat4, Mat6, OdometryState
from tests.edge.cameras.device_tree import MadeTree
from tests.edge.cameras.scripted_kernel import Picture, ScriptedKernel, Unplugged, grey
from tests.edge.runtime import scripted

PATIENCE_S = 60.0
CONFIG = Config(
    outputs=OutputsConfig(zmq=ZmqConfig(endpoint="tcp://127.0.0.1:*", status_interval_s=0.01)),
    runtime=RuntimeConfig(ladder=LadderConfig(enabled=False)),  # a busy machine is no reason here
)


class Stages:
    """Stages that know the truth by each frame's number."""

    def __init__(self) -> None:
        self.map: Map | None = None
        self.resets = 0
        self.damage = ""
        self.reports: list[FrameReport] = []
        self._pipeline = Pipeline(
            scripted.TrueOdometry(),
            Registration(RegistrationConfig(keep_trajectory=False)),
            self._search(),
            RuntimeConfig(),
            time.monotonic_ns,
            KeyframeTimes(time.monotonic_ns, inline=True),
        )

    def step(self, frame: Frame) -> FrameReport:
        if self.damage:
            raise TileError(self.damage)
        self.reports.append(self._pipeline.step(frame))
        return self.reports[-1]

    def use_map(self, opened: OpenedMap) -> Search:
        self.map = opened.map
        return self._pipeline.replace_map(self._search(), Registration(RegistrationConfig()))

    def drop_map(self) -> None:
        self.map, self.damage = None, ""
        self._pipeline.replace_map(NoSearch(), Registration(RegistrationConfig()))

    def reset(self) -> None:
        self.resets += 1

    def set_start(self, T_map_cam: Mat4, covariance: Mat6) -> None:
        self._pipeline.set_start(T_map_cam, covariance)

    def use_preset(self, config: OdometryConfig) -> None:
        """Nothing depends on it here."""

    def stretch_queries(self, factor: int) -> None:
        self._pipeline.stretch_queries(factor)

    def _search(self) -> Search:
        return DelayedSearch(scripted.TrueRelocaliser(), 3, time.monotonic_ns)


class PatientKernel(ScriptedKernel):
    """Its clock stands still while the script is empty, so that waiting is no stall."""

    def poll(self, fd: int, timeout_s: float) -> int:
        if self.script or not (self._plugged and self._streams):
            return super().poll(fd, timeout_s)
        time.sleep(0.001)
        return 0


class Device:
    """A daemon in a thread of its own, and a desk at which its camera is unplugged."""

    def __init__(self, folder: Path, config: Config = CONFIG) -> None:
        calibration = folder / "camera.toml"
        calibration.write_text(camera_toml(scripted.CAMERA, 30.0, ""))
        made = MadeTree(folder / "tree")
        made.plug("1.2", 0, "A1")
        self.kernel = PatientKernel([])
        v4l2 = {"width": 64, "height": 48, "serial": "A1", "stall_s": 5.0}
        settings = {"source": "v4l2", "calibration": str(calibration), "v4l2": v4l2}
        source = open_live(msgspec.convert(settings, CameraConfig), self.kernel, made.tree)
        self.stages = Stages()
        self._publisher = ZmqPublisher(config.outputs.zmq)
        self._player = LivePlayer(source, lambda: None)
        switch = MapSwitch(lambda _: OpenedMap(open_map(MAP_FOLDER), NoSearch(), scripted.CAMERA))
        self.daemon = Daemon(config, self.stages, self._player, self._publisher, switch)  # type: ignore[arg-type]
        self.thread = threading.Thread(target=self.daemon.run)
        self.thread.start()

    def feed(self, count: int, **more: float) -> None:
        """So many frames, each taken before the next comes."""
        for _ in range(count):
            seen = len(self.stages.reports)
            self.kernel.script.append(Picture(grey(seen).tobytes(), **more))  # type: ignore[arg-type]
            self.wait_for(lambda seen=seen: len(self.stages.reports) > seen)  # type: ignore[misc]

    def wait_for(self, true: Callable[[], bool]) -> None:
        until_s = time.monotonic() + PATIENCE_S
        while not true():
            assert time.monotonic() < until_s, "it never came"
            time.sleep(0.001)

    def wait_for_status(self, **wanted: object) -> StatusMessage:
        def is_so() -> bool:
            status = self._publisher.status
            return status is not None and all(getattr(status, k) == v for k, v in wanted.items())

        self.wait_for(is_so)
        assert self._publisher.status is not None
        return self._publisher.status

    @property
    def losses(self) -> int:
        return self._player.losses

    def assert_right(self) -> None:
        """Every pose that was published is the true one."""
        published = [report.pose for report in self.stages.reports if report.pose is not None]
        assert published
        for pose in published:
            assert np.allclose(pose.T_map_cam, scripted.true_pose(pose.index), atol=1e-6)

    def close(self) -> None:
        self.daemon.stop()
        self.thread.join()
        self._player.close()
        self.daemon.close()
        self._publisher.close()


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    gc.collect()
    threads, files = set(threading.enumerate()), len(list(Path("/proc/self/fd").iterdir()))
    device = Device(tmp_path)
    yield device
    device.close()
    device.stages.map = None  # holds its files as long as somebody has it
    gc.collect()
    assert set(threading.enumerate()) <= threads
    assert len(list(Path("/proc/self/fd").iterdir())) <= files
    assert not device.kernel.fds


def localised(device: Device) -> bool:
    return device.stages.reports[-1].pose is not None


def test_camera_unplugged_twice_comes_back_each_time(device: Device) -> None:
    for round_ in (1, 2):
        device.feed(25)
        assert localised(device)
        device.kernel.script.append(Unplugged())
        device.wait_for(lambda round_=round_: device.losses == round_)  # type: ignore[misc]
        assert device.daemon.map_folder is None  # it still answers
        device.kernel.plug()
    device.feed(25)
    assert localised(device)
    device.assert_right()
    indices = [report.update.index for report in device.stages.reports]
    assert indices == sorted(set(indices))


def test_stall_of_five_seconds_is_a_loss_and_then_forgotten(device: Device) -> None:
    device.feed(25)
    device.feed(1, late_s=5.5)
    device.feed(20)
    assert device.losses == 1
    assert localised(device)
    device.assert_right()


def test_another_size_after_a_replug_is_refused_until_it_is_right(
    device: Device, caplog: pytest.LogCaptureFixture
) -> None:
    device.feed(25)
    device.kernel.script.append(Unplugged())
    device.wait_for(lambda: device.losses == 1)
    device.kernel.sizes = {"GREY": (32, 24)}
    device.kernel.plug()
    device.wait_for_status(camera="refused")
    taken = len(device.stages.reports)
    assert caplog.text.count("event=camera_refused") == 1
    device.kernel.sizes = {"GREY": (64, 48)}
    device.feed(25)
    assert len(device.stages.reports) == taken + 25
    device.wait_for_status(camera="ok")
    device.assert_right()


def test_stamps_of_another_clock_are_refused_until_they_are_right(device: Device) -> None:
    device.feed(25)
    step_ns = 3_600_000_000_000  # somebody sets the clock, and the driver stamps by it
    device.kernel.script.append(Picture(grey(0).tobytes(), stamp_offset_ns=step_ns))
    device.wait_for_status(camera="refused")
    device.feed(25)
    assert localised(device)
    device.assert_right()


def test_commands_and_swaps_work_without_any_frame(device: Device) -> None:
    assert device.daemon.act(ResetCommand())
    device.wait_for(lambda: device.stages.resets == 1)
    device.daemon.swap(MAP_FOLDER)
    assert device.daemon.map_folder == MAP_FOLDER
    assert device.daemon.localised() == (0, 0)


def test_a_map_that_proves_damaged_is_left_out_and_tracking_goes_on(device: Device) -> None:
    device.daemon.swap(MAP_FOLDER)
    device.feed(25)
    assert localised(device)
    device.stages.damage = "tiles/7.tile is damaged"
    device.feed(5)
    assert device.stages.reports[-1].update.state is OdometryState.TRACKING
    assert not localised(device)
    device.wait_for_status(notice="going on without a map: tiles/7.tile is damaged", map="")
    device.daemon.swap(MAP_FOLDER)
    device.wait_for_status(notice="", map=MAP_FOLDER.name)
    device.feed(25)
    assert localised(device)


def test_counts_are_those_of_the_map_in_use(device: Device) -> None:
    device.feed(40)
    tracked, published = device.daemon.localised()
    assert tracked >= 39
    assert 0 < published < tracked
    device.daemon.swap(MAP_FOLDER)
    assert device.daemon.localised().published == 0
    device.feed(30)
    assert localised(device)


def test_nobody_waits_for_another_map_once_the_loop_has_ended(device: Device) -> None:
    device.daemon.stop()
    device.thread.join()
    with pytest.raises(SwapRefused, match="the program ends"):
        device.daemon.swap(MAP_FOLDER)


def test_notice_is_told_in_log_and_status(device: Device, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        device.daemon.tell("hall-7 refused: expired")
    assert "event=notice hall-7 refused: expired" in caplog.text
    device.wait_for_status(notice="hall-7 refused: expired")


def test_too_slow_device_gives_up_step_by_step_and_says_so(tmp_path: Path) -> None:
    # Any time is too much.
    ladder = LadderConfig(busy_share=1e-6, idle_share=1e-7, down_after_s=0.0)
    config = msgspec.structs.replace(CONFIG, runtime=RuntimeConfig(ladder=ladder))
    device = Device(tmp_path, config)
    while (status := device._publisher.status) is None or status.level < 2:
        device.kernel.script.append(Picture(grey(0).tobytes()))
        time.sleep(0.02)
    device.close()
    assert status.given_up == ("the map is searched less often", "every second frame")
    assert any(reason.startswith("slow: tracking takes") for reason in status.reasons)
    assert device._player.keep_every == 2
    asked = [report.fixes for report in device.stages.reports]
    assert any(asked)
