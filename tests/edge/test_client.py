# SPDX-License-Identifier: Apache-2.0
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import zmq

from edge.client import (
    ControlClient,
    Keys,
    NoAnswer,
    PoseClient,
    PoseMessage,
    Refused,
    StatusMessage,
    Transform,
)
from edge.config.outputs import CurveConfig, MetricsConfig, OutputsConfig, ZmqConfig
from edge.errors import OutputError, TileError
from edge.outputs.control import Command, ResetCommand, StartPoseCommand
from edge.outputs.curve import CurveServer, make_key_pair
from edge.outputs.status import Facts
from edge.outputs.zmq_pub import ZmqPublisher
from edge.runtime.services import Answers, Services
from tests.edge.outputs import reports

PATIENCE_S = 60.0
HERE = Transform(1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0)


class Device:
    """The daemon's sockets, with a tracking thread that publishes the same frame on and on."""

    def __init__(self, curve_config: CurveConfig | None = None) -> None:
        self.commands: list[Command] = []
        self.swapped: list[Path] = []
        self.kept: list[str] = []
        self.busy = False
        self._context = zmq.Context()
        curve = None if curve_config is None else CurveServer(curve_config, self._context)
        any_port = ZmqConfig(
            endpoint="tcp://127.0.0.1:*", control="tcp://127.0.0.1:*", status_interval_s=0.02
        )
        self._publisher = ZmqPublisher(any_port, self._context, curve)
        self._publisher.send_status(Facts(map="hall"))
        self.services = Services(
            OutputsConfig(zmq=any_port, metrics=MetricsConfig(port=0)),
            self._context,
            curve,
            Answers(
                act=self._act,
                swap=self._swap,
                keep=self._keep,
                status=lambda: self._publisher.status,
                metrics=lambda: "",
            ),
        )
        assert self.services.control is not None
        self.stream, self.control = self._publisher.endpoint, self.services.control.endpoint
        self.services.start()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def close(self) -> None:
        self._stopped.set()
        self._thread.join()
        self.services.close()
        self._publisher.close()
        self._context.term()

    def _publish(self) -> None:
        index = 0
        while not self._stopped.wait(0.002):
            self._publisher.write(reports.report(index), lambda: Facts(map="hall"))
            index += 1

    def _act(self, command: Command) -> bool:
        if not self.busy:
            self.commands.append(command)
        return not self.busy

    def _keep(self, reason: str) -> None:
        if self.busy:
            raise OutputError("recorder.folder: is empty")
        self.kept.append(reason)

    def _swap(self, folder: Path) -> None:
        if folder.name == "bad":
            raise TileError("bad: damaged")
        self.swapped.append(folder)


@pytest.fixture
def device() -> Iterator[Device]:
    with closing(Device()) as device:
        yield device


def test_poses_come_one_after_the_other(device: Device) -> None:
    with PoseClient(device.stream) as client:
        indices = [pose.index for pose, _ in zip(client, range(5), strict=False)]
    assert indices == list(range(indices[0], indices[0] + 5))


def test_newest_only_leaves_out_what_was_not_read(device: Device) -> None:
    with PoseClient(device.stream, newest_only=True) as client:
        first = client.receive(PoseMessage, PATIENCE_S)
        skipped = False
        while not skipped:
            threading.Event().wait(0.1)
            newest = client.receive(PoseMessage, PATIENCE_S)
            skipped = newest.index > first.index + 1
            first = newest


def test_status_is_typed_and_the_wrong_kind_refused(device: Device) -> None:
    with PoseClient(device.stream, topic="status") as client:
        assert client.receive(StatusMessage, PATIENCE_S).map == "hall"
        with pytest.raises(TypeError, match="StatusMessage, not PoseMessage"):
            client.receive(PoseMessage)
    with pytest.raises(ValueError, match="pose"):
        PoseClient(device.stream, topic="poses")


def test_commands_reach_the_tracking(device: Device) -> None:
    with ControlClient(device.control) as client:
        client.reset()
        client.set_start(HERE, sigma_m=0.5)
        client.keep("lost at the door")
        assert client.status().map == "hall"
    assert device.commands == [
        ResetCommand(id=1),
        StartPoseCommand(id=2, T_map_cam=HERE, sigma_m=0.5),
    ]
    assert device.kept == ["lost at the door"]


def test_refusal_says_why(device: Device) -> None:
    device.busy = True
    with ControlClient(device.control) as client:
        with pytest.raises(Refused, match="busy"):
            client.reset()
        with pytest.raises(Refused, match="is empty"):
            client.keep()
        with pytest.raises(Refused, match="bad: damaged"):
            client.swap("/maps/bad")
        client.swap("/maps/good")
    assert device.swapped == [Path("/maps/good")]


def test_without_a_daemon_there_is_no_answer() -> None:
    with ControlClient("tcp://127.0.0.1:1", timeout_s=0.01) as client, pytest.raises(NoAnswer):
        client.reset()
    with PoseClient("tcp://127.0.0.1:1") as poses, pytest.raises(NoAnswer):
        poses.receive(PoseMessage, 0.01)


def test_only_known_keys_may_read_and_command(tmp_path: Path) -> None:
    for name in ("device", "friend", "stranger"):
        make_key_pair(tmp_path / f"{name}.key")
    config = CurveConfig(
        secret_key=str(tmp_path / "device.key"), clients=str(tmp_path / "friend.pub")
    )
    friend = Keys(tmp_path / "friend.key", tmp_path / "device.pub")
    stranger = Keys(tmp_path / "stranger.key", tmp_path / "device.pub")
    with closing(Device(config)) as device:
        for keys in (stranger, None):
            refused = device.services.refused_clients
            with PoseClient(device.stream, keys=keys) as poses:
                while device.services.refused_clients == refused:  # until it was answered
                    with pytest.raises(NoAnswer):
                        poses.receive(PoseMessage, 0.05)
            client = ControlClient(device.control, keys=keys, timeout_s=0.2)
            with client, pytest.raises(NoAnswer):
                client.reset()
        with ControlClient(device.control, keys=friend) as client:
            client.reset()
        with PoseClient(device.stream, keys=friend) as poses:
            poses.receive(PoseMessage, PATIENCE_S)
        assert len(device.commands) == 1
        assert device.services.refused_clients >= 2
