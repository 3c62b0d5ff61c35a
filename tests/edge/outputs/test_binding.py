# SPDX-License-Identifier: Apache-2.0
import socket
from pathlib import Path

import pytest
import zmq

from edge.errors import OutputError
from edge.outputs.binding import bind

PATIENCE_MS = 60_000


def test_an_endpoint_in_use_is_refused_and_goes_on_serving(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/poses"
    with zmq.Context() as context, context.socket(zmq.REP) as first:
        bind(first, endpoint, "here")
        with pytest.raises(OutputError, match=r"^here ipc://.*: Address already in use: end"):
            bind(context.socket(zmq.REP), endpoint, "here")
        with context.socket(zmq.REQ) as late:
            late.linger = 0
            late.connect(endpoint)
            late.send(b"still there?")
            assert first.poll(PATIENCE_MS)


def test_what_a_killed_program_left_is_taken(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(tmp_path / "poses"))  # and never unlinked
    endpoint = f"ipc://{tmp_path}/poses"
    with zmq.Context() as context, context.socket(zmq.REP) as next_one:
        assert bind(next_one, endpoint, "here") == endpoint


def test_a_place_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    with zmq.Context() as context, pytest.raises(OutputError, match=r"^here ipc://"):
        bind(context.socket(zmq.REP), f"ipc://{tmp_path}/none/poses", "here")
