# SPDX-License-Identifier: Apache-2.0
import math
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq

from edge.outputs import control
from edge.outputs.control import ControlSocket

START: dict[str, Any] = {
    "command": "start_pose",
    "T_map_cam": {"x": 1.0, "y": 2.0, "z": 3.0, "qw": 2.0, "qx": 0.0, "qy": 0.0, "qz": 0.0},
}


@pytest.fixture
def context() -> Iterator["zmq.Context[zmq.Socket[bytes]]"]:
    context = zmq.Context()
    yield context
    context.destroy(linger=0)


def test_start_pose_is_a_pose_with_its_covariance() -> None:
    command = control.decode(msgspec.json.encode(START | {"sigma_m": 0.5, "sigma_deg": 10}))
    assert isinstance(command, control.StartPoseCommand)
    T, covariance = command.pose()
    assert np.allclose(T[:3, 3], [1, 2, 3])
    assert np.allclose(T[:3, :3], np.eye(3))  # the quaternion was of length 2
    assert np.allclose(np.diag(covariance), [0.25] * 3 + [math.radians(10) ** 2] * 3)


@pytest.mark.parametrize(
    "request_",
    [
        b"",
        b"status",
        b"{}",
        b'{"command":"explode"}',
        b'{"command":"status","extra":1}',
        b'{"command":"swap"}',
        b'{"command":"swap","map":""}',
        b'{"command":"keep","reason":"' + b"a" * 201 + b'"}',
        b'{"command":"swap","map":"' + b"a" * 2000 + b'"}',
        b"[" * 3000,
        msgspec.json.encode(START | {"sigma_m": 0.0}),
        msgspec.json.encode(START | {"sigma_m": 1e300}),
        msgspec.json.encode(START | {"T_map_cam": START["T_map_cam"] | {"qw": 0.0}}),
        msgspec.json.encode(START | {"T_map_cam": START["T_map_cam"] | {"x": None}}),
    ],
)
def test_what_is_no_command_is_refused(request_: bytes) -> None:
    with pytest.raises(control.CommandError):
        control.decode(request_)


def test_both_kinds_of_client_get_their_reply(
    context: "zmq.Context[zmq.Socket[bytes]]",
) -> None:
    with closing(ControlSocket("tcp://127.0.0.1:*", context, None)) as server:
        for kind in (zmq.REQ, zmq.DEALER):
            client = context.socket(kind)
            client.connect(server.endpoint)
            client.send(b'{"command":"reset","id":7}')
            while not (asked := server.take()):
                server.socket.poll(1000)
            assert asked[0].command == control.ResetCommand(id=7)
            server.reply(asked[0].envelope, control.Reply(True, 1, 7))
            assert msgspec.json.decode(client.recv()) == {"ok": True, "schema": 1, "id": 7}
            client.close(linger=0)


def test_noise_is_answered_or_dropped_and_the_next_command_works(
    context: "zmq.Context[zmq.Socket[bytes]]",
) -> None:
    rng = np.random.default_rng(3)
    with closing(ControlSocket("tcp://127.0.0.1:*", context, None)) as server:
        hostile, huge, client = (context.socket(zmq.DEALER) for _ in range(3))
        for socket in (hostile, huge, client):
            socket.connect(server.endpoint)
        for _ in range(200):
            parts = [rng.bytes(int(rng.integers(0, 200))) for _ in range(rng.integers(1, 7))]
            hostile.send_multipart(parts)
            assert server.take() == []
        huge.send(b'{"command":"reset"}' + 1_000_000 * b" ")
        client.send(b'{"command":"status"}')
        asked: list[control.Asked] = []
        while not (asked and server.refused):  # which of them comes first nobody knows
            server.socket.poll(10)
            asked += server.take()
        assert isinstance(asked[0].command, control.StatusCommand)
        for socket in (hostile, huge, client):
            socket.close(linger=0)
