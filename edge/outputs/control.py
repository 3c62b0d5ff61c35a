# SPDX-License-Identifier: Apache-2.0
"""Commands to the daemon over ZeroMQ: JSON in, JSON out; PROTOCOL.md describes them."""

import logging
import math
from typing import NamedTuple, TypeAlias

import msgspec
import numpy as np
import zmq

from edge.errors import EdgeError
from edge.geometry import se3
from edge.outputs import wire
from edge.outputs.binding import bind
from edge.outputs.curve import CurveServer
from edge.types import Mat4, Mat6

log = logging.getLogger(__name__)

_MAX_REQUEST_BYTES = 4096
_MAX_FRAMES = 4  # identity, an empty one from a REQ socket, the request
_MAX_PATH = 1024
_MAX_REASON = 200
_REQUESTS_A_CALL = 64


class _Request(
    msgspec.Struct, frozen=True, kw_only=True, tag_field="command", forbid_unknown_fields=True
):
    """What every command has; `id` comes back in the reply."""

    id: int | str | None = None


class StatusCommand(_Request, frozen=True, tag="status"):
    """Asks for the status."""


class ResetCommand(_Request, frozen=True, tag="reset"):
    """Forget where the camera is and begin anew."""


class StartPoseCommand(_Request, frozen=True, kw_only=True, tag="start_pose"):
    """Look for the camera near this pose first."""

    T_map_cam: wire.Transform
    sigma_m: float = 1.0
    sigma_deg: float = 20.0

    def __post_init__(self) -> None:
        numbers = [*msgspec.structs.astuple(self.T_map_cam), self.sigma_m, self.sigma_deg]
        if not all(math.isfinite(value) and abs(value) < 1e9 for value in numbers):
            raise ValueError("a number is not finite or too large")
        if not 0.1 < math.sqrt(sum(value * value for value in numbers[3:7])) < 10.0:
            raise ValueError("qw, qx, qy, qz are no unit quaternion")
        if min(self.sigma_m, self.sigma_deg) <= 0.0:
            raise ValueError("sigma_m and sigma_deg must be above 0")

    def pose(self) -> tuple[Mat4, Mat6]:
        """`T_map_cam` (4, 4) and the covariance (6, 6) of its position and rotation."""
        x, y, z, qw, *qxyz = msgspec.structs.astuple(self.T_map_cam)
        q = np.array([*qxyz, qw])
        T = se3.from_tum([x, y, z, *(q / np.linalg.norm(q))])
        variances = (self.sigma_m**2, math.radians(self.sigma_deg) ** 2)
        return T, np.diag(np.repeat(variances, 3))


class SwapCommand(_Request, frozen=True, kw_only=True, tag="swap"):
    """Use another map from now on."""

    map: str  # its folder on the device

    def __post_init__(self) -> None:
        if not 0 < len(self.map) <= _MAX_PATH or "\0" in self.map:
            raise ValueError("map must name a folder")


class KeepCommand(_Request, frozen=True, tag="keep"):
    """Put the last recordings aside, so that the ring does not overwrite them."""

    reason: str = ""

    def __post_init__(self) -> None:
        if len(self.reason) > _MAX_REASON:
            raise ValueError(f"reason is longer than {_MAX_REASON} letters")


Command: TypeAlias = StatusCommand | ResetCommand | StartPoseCommand | SwapCommand | KeepCommand


class Reply(msgspec.Struct, frozen=True, omit_defaults=True):
    """Answer to one command."""

    ok: bool
    schema: int
    id: int | str | None = None
    error: str = ""
    status: wire.StatusMessage | None = None


class Asked(NamedTuple):
    """A command and where its reply goes."""

    envelope: list[bytes]
    command: Command


class CommandError(EdgeError):
    """A request that is no command."""


_DECODER: msgspec.json.Decoder[Command] = msgspec.json.Decoder(Command)


def decode(request: bytes) -> Command:
    """The command in a request; CommandError says what is wrong with it."""
    try:
        return _DECODER.decode(request)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise CommandError(f"{error}; PROTOCOL.md lists the commands") from error


class ControlSocket:
    """A ROUTER socket; whatever comes gets one reply or none, and never stops it.

    Owned by one thread.
    """

    def __init__(
        self,
        endpoint: str,
        context: "zmq.Context[zmq.Socket[bytes]]",
        curve: CurveServer | None,
    ) -> None:
        self.socket = context.socket(zmq.ROUTER)
        self.socket.linger = 200
        self.socket.rcvhwm = self.socket.sndhwm = _REQUESTS_A_CALL
        self.socket.maxmsgsize = _MAX_REQUEST_BYTES
        if curve is not None:
            curve.protect(self.socket)
        self.endpoint = bind(self.socket, endpoint, "outputs.zmq.control")
        self.refused = 0
        log.info("event=control_bound endpoint=%s", self.endpoint)

    def take(self) -> list[Asked]:
        """Commands that have come; what is none is told so. Never waits."""
        asked = []
        for _ in range(_REQUESTS_A_CALL):
            try:
                frames = self.socket.recv_multipart(zmq.DONTWAIT)
            except zmq.Again:
                break
            envelope, request = frames[:-1], frames[-1]
            if not envelope or len(frames) > _MAX_FRAMES:
                self.refused += 1
                continue
            try:
                asked.append(Asked(envelope, decode(request)))
            except CommandError as error:
                self.refused += 1
                self.reply(envelope, Reply(False, wire.SCHEMA_VERSION, error=str(error)))
        return asked

    def reply(self, envelope: list[bytes], reply: Reply) -> None:
        """Answer; who is gone or does not read loses it."""
        try:
            self.socket.send_multipart([*envelope, msgspec.json.encode(reply)], zmq.DONTWAIT)
        except zmq.ZMQError:
            log.debug("event=reply_lost")

    def close(self) -> None:
        """Free the port."""
        self.socket.close()
