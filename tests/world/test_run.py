# SPDX-License-Identifier: Apache-2.0
"""The daemon as its users start it."""

import os
import queue
import shutil
import signal
import socket
import subprocess
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from edge.cameras.recording import open_recording
from edge.client import (
    ControlClient,
    Keys,
    NoAnswer,
    PoseClient,
    PoseMessage,
    Refused,
    StatusMessage,
)
from edge.outputs.curve import make_key_pair
from tests.maps.small_map import edited_manifest
from tests.world.command import assert_refused, command, mapvo
from tests.world.conftest import World

pytestmark = [pytest.mark.world, pytest.mark.slow]

RIGHT_M = 0.2  # in a room of 6 m, where a busy machine overtakes frames
PATIENCE_S = 600.0  # kernels may have to be compiled first, on a loaded machine


class Systemd:
    """Hears at once what the daemon says: a socket that nobody reads holds ten messages."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._path = path
        self._said: queue.Queue[str] = queue.Queue()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def hears(self, text: str) -> None:
        """Wait until the daemon has said it."""
        while not self._said.get(timeout=PATIENCE_S).startswith(text):
            pass

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as last:
            last.sendto(b"", str(self._path))
        self._thread.join()
        self._socket.close()

    def _listen(self) -> None:
        while said := self._socket.recv(4096):
            self._said.put(said.decode())


class Daemon:
    """`mapvo run` with sockets of its own in `folder`."""

    def __init__(
        self, folder: Path, world: World, more: str = "", map_: Path | None = None
    ) -> None:
        self.folder = folder
        self.stream, self.control = (f"ipc://{folder}/{name}" for name in ("stream", "control"))
        self.config = folder / "mapvo.toml"
        self.config.write_text(
            f'[camera]\nrecording = "{world.query}"\n'
            f'[map]\nfolder = "{map_ or world.map}"\n'
            "[runtime.ladder]\nenabled = false\n"  # a busy machine is no reason here
            f'[outputs.zmq]\nendpoint = "{self.stream}"\ncontrol = "{self.control}"\n'
            "status_interval_s = 0.1\n[outputs.metrics]\nport = 0\n" + more
        )
        self.systemd = Systemd(folder / "notify")
        self.process = self.start()

    def start(self) -> "subprocess.Popen[bytes]":
        environment = os.environ | {
            "NOTIFY_SOCKET": str(self.folder / "notify"),
            "WATCHDOG_USEC": "2000000",
        }
        environment.pop("JOURNAL_STREAM", None)
        with (self.folder / "log").open("a") as log:
            self.process = subprocess.Popen(
                command("run", "--config", self.config), stderr=log, env=environment
            )
        return self.process

    def end(self, number: signal.Signals) -> int:
        self.process.send_signal(number)
        return self.process.wait(PATIENCE_S)

    def log(self) -> str:
        return (self.folder / "log").read_text()

    def close(self) -> None:
        if self.process.poll() is None:
            self.end(signal.SIGKILL)
        self.systemd.close()


@contextmanager
def running(*arguments: object, **more: object) -> Iterator[Daemon]:
    daemon = Daemon(*arguments, **more)  # type: ignore[arg-type]
    try:
        daemon.systemd.hears("READY=1")
        yield daemon
    finally:
        daemon.close()


@pytest.fixture(scope="module")
def daemon(world: World, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with running(tmp_path_factory.mktemp("daemon"), world) as daemon:
        yield daemon


def assert_right(world: World, poses: list[PoseMessage]) -> None:
    """Each pose is that of its frame, in play forth and back."""
    recording = open_recording(world.query)
    truth = recording.groundtruth
    assert truth is not None
    count = len(recording)
    order = [*range(count), *range(count - 2, 0, -1)]
    for pose in poses:
        T = truth.pose_at(int(recording.t_ns[order[pose.index % len(order)]]))
        assert T is not None
        place = np.array([pose.T_map_cam.x, pose.T_map_cam.y, pose.T_map_cam.z])
        assert np.linalg.norm(place - T[:3, 3]) < RIGHT_M


def some_poses(daemon: Daemon, count: int, keys: Keys | None = None) -> list[PoseMessage]:
    with PoseClient(daemon.stream, keys=keys) as client:
        return [client.receive(PoseMessage, PATIENCE_S) for _ in range(count)]


def wait_for_status(daemon: Daemon, **wanted: object) -> StatusMessage:
    with PoseClient(daemon.stream, topic="status") as client:
        while True:
            status = client.receive(StatusMessage, PATIENCE_S)
            if all(getattr(status, name) == value for name, value in wanted.items()):
                return status


def test_poses_are_right_and_fresh(daemon: Daemon, world: World) -> None:
    poses = some_poses(daemon, 120)  # more than one way forth
    assert_right(world, poses)
    assert {pose.map for pose in poses} == {world.map.name}
    assert all(0 < pose.age_ns == pose.sent_ns - pose.t_ns for pose in poses)
    moving = [pose for pose in poses if np.isfinite(pose.velocity_m_s[0])]
    assert moving  # all but the first few, where no frame is overtaken
    assert all(pose.T_map_cam_predicted is not None for pose in moving)


def test_status_says_how_it_goes(daemon: Daemon) -> None:
    status = wait_for_status(daemon, camera="ok", localised=True)
    assert status.frames > status.published > 0
    assert status.cpu_cores > 0.0
    assert status.level == 0


def test_watchdog_is_fed(daemon: Daemon) -> None:
    daemon.systemd.hears("WATCHDOG=1")


def test_map_is_exchanged_between_two_frames(daemon: Daemon, world: World, tmp_path: Path) -> None:
    other = shutil.copytree(world.map, tmp_path / "other")
    with ControlClient(daemon.control, timeout_s=PATIENCE_S) as control:
        with pytest.raises(Refused, match="is no map"):
            control.swap(tmp_path)
        before = some_poses(daemon, 1)[0]
        control.swap(other)
        status = wait_for_status(daemon, map="other", localised=True)
        assert status.state == "tracking"
        after = some_poses(daemon, 10)
        assert {pose.map for pose in after} == {"other"}
        assert after[0].reset_counter > before.reset_counter
        assert_right(world, after)
        control.swap(world.map)


def test_reset_and_start_pose_begin_anew(daemon: Daemon, world: World) -> None:
    before = some_poses(daemon, 1)[0]
    with ControlClient(daemon.control, timeout_s=PATIENCE_S) as control:
        control.reset()
        control.set_start(before.T_map_cam, sigma_m=0.5)
    while (poses := some_poses(daemon, 5))[0].reset_counter == before.reset_counter:
        pass
    assert_right(world, poses)


def holds_images(ring: Path) -> bool:
    """Whether images are on the disk: a file's head alone is smaller than one of them."""
    return sum(path.stat().st_size for path in ring.glob("*.mcap")) > 320 * 240


def test_killed_it_starts_again_and_sigterm_ends_it_in_good_order(
    world: World, tmp_path: Path
) -> None:
    ring = tmp_path / "ring"
    more = f'[recorder]\nfolder = "{ring}"\nmin_free_mb = 0\n'
    with running(tmp_path, world, more) as daemon:
        wait_for_status(daemon, localised=True)
        while not holds_images(ring):  # a kill loses the second under way
            some_poses(daemon, 1)
        assert daemon.end(signal.SIGKILL) == -signal.SIGKILL
        daemon.start()  # at the same sockets
        daemon.systemd.hears("READY=1")
        assert_right(world, some_poses(daemon, 5))
        with ControlClient(daemon.control, timeout_s=PATIENCE_S) as control:
            control.keep("at the door")
        assert daemon.end(signal.SIGTERM) == 0  # in the middle of a frame, mostly
        daemon.systemd.hears("STOPPING=1")
        assert "Traceback" not in daemon.log()
    kept = sorted((ring / "kept").glob("*-at-the-door/*.mcap"))
    assert len(kept) == 2  # what the killed one left was mended
    assert all(len(open_recording(file)) > 0 for file in kept)


def test_autopilot_reads_the_serial_line_and_strangers_nothing(
    world: World, tmp_path: Path
) -> None:
    level = shutil.copytree(world.map, tmp_path / "level")
    with edited_manifest(level) as manifest:
        manifest["T_local_map"] = np.eye(4).tolist()
    master, slave = os.openpty()
    tty.setraw(slave)
    for name in ("device", "friend", "stranger"):
        make_key_pair(tmp_path / f"{name}.key")
    friend, stranger = (
        Keys(tmp_path / f"{name}.key", tmp_path / "device.pub") for name in ("friend", "stranger")
    )
    outputs = (
        f'[outputs.serial]\ndevice = "{os.ttyname(slave)}"\n'
        f'[outputs.zmq.curve]\nsecret_key = "{tmp_path}/device.key"\n'
        f'clients = "{tmp_path}/friend.pub"\n'
    )
    with running(tmp_path, world, outputs, level) as daemon:
        assert_right(world, some_poses(daemon, 3, friend))
        assert_autopilot_understands(master)
        for keys in (stranger, None):
            with PoseClient(daemon.stream, keys=keys) as client, pytest.raises(NoAnswer):
                client.receive(PoseMessage, 1.0)
        with ControlClient(daemon.control, keys=friend, timeout_s=PATIENCE_S) as control:
            while control.status().refused_clients == 0:
                pass  # the daemon has not got round to it
        assert "event=client_refused" in daemon.log()
    os.close(master)
    os.close(slave)


def assert_autopilot_understands(master: int) -> None:
    """All kinds of messages come, whole, from the right component."""
    decoder = mavlink.MAVLink(None)
    decoder.robust_parsing = True
    seen: set[str] = set()
    os.read(master, 4096)  # nobody has read so far: what waits may begin within a message
    while not {"HEARTBEAT", "ODOMETRY"} <= seen:
        for message in decoder.parse_buffer(os.read(master, 4096)) or []:
            if message.get_type() == "BAD_DATA":
                continue  # what waits is thrown away where we read too slowly
            assert message.get_srcComponent() == 197
            seen.add(message.get_type())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[camera]\nrecording = "', ["is no TOML"]),  # torn while it was written
        ("[camera]\n", ["camera.recording", "is empty"]),
        ('[camera]\nrecording = "/nowhere"\n', ["/nowhere", "does not exist"]),
        (
            '[camera]\nrecording = "WORLD"\n[outputs.serial]\ndevice = "/dev/null"\n',
            ["map.folder", "MAVLink"],
        ),
        (
            '[camera]\nrecording = "WORLD"\n[map]\nfolder = "MAP"\n'
            '[outputs.serial]\ndevice = "/dev/null"\n',
            ["is not level", "mapvo-map align"],
        ),
        ('[outputs.zmq]\ncontrol = "tcp://*:5581"\n', ["control tcp://*:5581", "curve"]),
    ],
)
def test_what_cannot_run_is_said_in_one_line(
    world: World, tmp_path: Path, text: str, words: list[str]
) -> None:
    text = text.replace("WORLD", str(world.query)).replace("MAP", str(world.map))
    (tmp_path / "c.toml").write_text(text)
    assert_refused(mapvo("run", "--config", tmp_path / "c.toml"), *words)
