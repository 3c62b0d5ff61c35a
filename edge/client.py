# SPDX-License-Identifier: Apache-2.0
"""Reads the live stream, and commands the daemon, from another program.

    with PoseClient() as client:
        for pose in client:
            print(pose.t_ns, pose.T_map_cam)

edge/outputs/PROTOCOL.md describes the messages for other languages.
"""

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

import msgspec
import zmq

from edge.errors import EdgeError
from edge.outputs import wire
from edge.outputs.control import (
    Command,
    KeepCommand,
    Reply,
    ResetCommand,
    StartPoseCommand,
    SwapCommand,
)
from edge.outputs.control import StatusCommand as _StatusCommand
from edge.outputs.curve import read_keys
from edge.outputs.wire import (
    FixMessage,
    OdomMessage,
    PoseMessage,
    StatusMessage,
    Transform,
    WelcomeMessage,
)

__all__ = [
    "ControlClient",
    "FixMessage",
    "KeepCommand",
    "Keys",
    "NoAnswer",
    "OdomMessage",
    "PoseClient",
    "PoseMessage",
    "Refused",
    "Reply",
    "ResetCommand",
    "StartPoseCommand",
    "StatusMessage",
    "SwapCommand",
    "Transform",
    "WelcomeMessage",
]

STREAM = "tcp://127.0.0.1:5580"
CONTROL = "tcp://127.0.0.1:5581"

M = TypeVar("M", bound=wire.Message)


class NoAnswer(EdgeError):
    """Nothing came in time: the daemon does not run, or does not let this client in."""


class Refused(EdgeError):
    """The daemon says that it does not do so, and why."""


class Keys:
    """Key files for encrypted connections: this client's own, and the device's public one."""

    def __init__(self, secret_key: str | Path, server_key: str | Path) -> None:
        self._secret = read_keys(Path(secret_key))[0]
        self._server = read_keys(Path(server_key))[0]

    def use(self, socket: "zmq.Socket[bytes]") -> None:
        """Let `socket`, not yet connected, be let in."""
        socket.curve_secretkey = self._secret
        socket.curve_publickey = zmq.curve_public(self._secret)
        socket.curve_serverkey = self._server


class _Client:
    """A socket of its own and the end of it."""

    def __init__(self, kind: int, keys: Keys | None) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(kind)
        if keys is not None:
            keys.use(self._socket)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Hang up."""
        self._socket.close(linger=0)
        self._context.term()


class PoseClient(_Client):
    """Messages as they come; a message that is no message of the protocol is a WireError.

    With `newest_only` what has not been read is overwritten, which is what who steers by poses
    wants; then ask for one kind alone. Owned by one thread.
    """

    def __init__(
        self,
        endpoint: str = STREAM,
        *,
        topic: str = "pose",
        newest_only: bool = False,
        keys: Keys | None = None,
    ) -> None:
        if topic not in wire.TOPICS:
            raise ValueError(f"topic {topic!r}: one of {', '.join(wire.TOPICS)}")
        super().__init__(zmq.SUB, keys)
        self._socket.conflate = newest_only
        self._kind = wire.TOPICS[topic]
        self._socket.subscribe(f"{topic} ")
        self._socket.connect(endpoint)

    def __iter__(self) -> Iterator[PoseMessage]:
        """Poses for ever; for the topic `pose`."""
        while True:
            yield self.receive(PoseMessage)

    def receive(self, kind: type[M], timeout_s: float | None = None) -> M:
        """The next message, which must be of `kind`; NoAnswer if none comes in time."""
        if kind is not self._kind:
            raise TypeError(f"this client is for {self._kind.__name__}, not {kind.__name__}")
        timeout_ms = None if timeout_s is None else round(timeout_s * 1e3)
        if not self._socket.poll(timeout_ms):
            raise NoAnswer(f"no {kind.__name__} within {timeout_s} s")
        message = wire.decode(self._socket.recv())[1]
        assert isinstance(message, kind)
        return message


class ControlClient(_Client):
    """Commands to the daemon; each waits for its reply. Owned by one thread."""

    def __init__(
        self, endpoint: str = CONTROL, *, keys: Keys | None = None, timeout_s: float = 30.0
    ) -> None:
        super().__init__(zmq.DEALER, keys)
        self._timeout_s = timeout_s
        self._asked = 0
        self._socket.connect(endpoint)

    def status(self) -> StatusMessage:
        """How it goes now."""
        status = self.ask(_StatusCommand()).status
        assert status is not None
        return status

    def reset(self) -> None:
        """Let it forget where the camera is and begin anew."""
        self.ask(ResetCommand())

    def set_start(
        self, T_map_cam: Transform, sigma_m: float = 1.0, sigma_deg: float = 20.0
    ) -> None:
        """Let it look near there first."""
        self.ask(StartPoseCommand(T_map_cam=T_map_cam, sigma_m=sigma_m, sigma_deg=sigma_deg))

    def swap(self, map_folder: str | Path) -> None:
        """Let it use another map; returns when it does."""
        self.ask(SwapCommand(map=str(map_folder)))

    def keep(self, reason: str = "") -> None:
        """Let it put the last recordings aside, so that its ring does not overwrite them."""
        self.ask(KeepCommand(reason=reason))

    def ask(self, command: Command) -> Reply:
        """The reply to `command`; Refused if it is not done, NoAnswer if none comes in time."""
        self._asked += 1
        command = msgspec.structs.replace(command, id=self._asked)
        self._socket.send(msgspec.json.encode(command))
        while self._socket.poll(round(self._timeout_s * 1e3)):
            reply = msgspec.json.decode(self._socket.recv(), type=Reply)
            if reply.id == self._asked:  # else to one that was given up
                if not reply.ok:
                    raise Refused(reply.error)
                return reply
        raise NoAnswer(f"no reply within {self._timeout_s:g} s: does the daemon run?")
