# SPDX-License-Identifier: Apache-2.0
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import zmq

from edge.config.outputs import CurveConfig, ZmqConfig
from edge.errors import ConfigError, OutputError
from edge.outputs.curve import CurveServer, allowed_clients, make_key_pair, read_keys
from edge.outputs.zmq_pub import ZmqPublisher
from tests.edge.outputs import reports

ROUNDS = 6000


class Server:
    """A publisher that lets in whoever is in `clients.keys`, driven by hand."""

    def __init__(self, folder: Path) -> None:
        make_key_pair(folder / "server.key")
        self.clients = folder / "clients.keys"
        self.clients.write_text("# nobody yet\n")
        self.context = zmq.Context()
        config = CurveConfig(secret_key=str(folder / "server.key"), clients=str(self.clients))
        self.curve = CurveServer(config, self.context)
        self.publisher = ZmqPublisher(
            ZmqConfig(endpoint="tcp://127.0.0.1:*"), self.context, self.curve
        )
        self.key = read_keys(folder / "server.pub")[0]
        self._index = 0

    def step(self) -> None:
        self.curve.answer()
        self.publisher.write(reports.report(self._index))
        self._index += 1

    def close(self) -> None:
        self.publisher.close()
        self.curve.close()
        self.context.term()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with closing(Server(tmp_path)) as server:
        yield server


def subscriber(context: "zmq.Context[zmq.Socket[bytes]]") -> "zmq.Socket[bytes]":
    socket = context.socket(zmq.SUB)
    socket.linger = 0
    socket.subscribe("pose ")
    return socket


def hears(server: Server, socket: "zmq.Socket[bytes]", rounds: int = ROUNDS) -> bool:
    for _ in range(rounds):
        server.step()
        if socket.poll(10):
            return True
    return False


def test_known_client_is_let_in_and_others_get_nothing(server: Server, tmp_path: Path) -> None:
    good, bad = zmq.curve_keypair(), zmq.curve_keypair()
    server.clients.write_text(f"# the planner\n{good[0].decode()}  # of 2026\n")
    context = zmq.Context()
    stranger, plain, friend = (subscriber(context) for _ in range(3))
    for socket, keys in ((stranger, bad), (friend, good)):
        socket.curve_publickey, socket.curve_secretkey = keys
        socket.curve_serverkey = server.key
    for socket in (stranger, plain):
        socket.connect(server.publisher.endpoint)
    while server.curve.refused < 2:  # both have knocked
        server.step()
    friend.connect(server.publisher.endpoint)
    assert hears(server, friend)
    assert not stranger.poll(0)
    assert not plain.poll(0)
    context.destroy(linger=0)


def test_list_is_read_again_when_it_changes(server: Server) -> None:
    keys = zmq.curve_keypair()
    context = zmq.Context()
    socket = subscriber(context)
    socket.reconnect_ivl = 20
    socket.curve_publickey, socket.curve_secretkey = keys
    socket.curve_serverkey = server.key
    socket.connect(server.publisher.endpoint)
    while server.curve.refused == 0:
        server.step()
    server.clients.write_text("half a key")  # torn while it was written: the old list stays
    refused = server.curve.refused
    late = subscriber(context)
    late.curve_publickey, late.curve_secretkey, late.curve_serverkey = *keys, server.key
    late.connect(server.publisher.endpoint)
    while server.curve.refused == refused:
        server.step()
    server.clients.write_bytes(keys[0] + b"\n")
    again = subscriber(context)
    again.curve_publickey, again.curve_secretkey, again.curve_serverkey = *keys, server.key
    again.connect(server.publisher.endpoint)
    assert hears(server, again)
    context.destroy(linger=0)


def test_key_pair_is_for_its_owner_alone_and_never_overwritten(tmp_path: Path) -> None:
    public = make_key_pair(tmp_path / "planner.key")
    assert public == tmp_path / "planner.pub"
    assert (tmp_path / "planner.key").stat().st_mode & 0o777 == 0o600
    before = (tmp_path / "planner.key").read_bytes()
    with pytest.raises(OutputError, match=r"planner\.key"):
        make_key_pair(tmp_path / "planner.key")
    assert (tmp_path / "planner.key").read_bytes() == before
    assert zmq.curve_public(read_keys(tmp_path / "planner.key")[0]) == read_keys(public)[0]


def test_hash_within_a_key_begins_no_comment(tmp_path: Path) -> None:
    key = zmq.curve_keypair()[0][:-1] + b"#"
    (tmp_path / "keys").write_bytes(b"  # mine\n" + key + b" # laptop\n\n")
    assert allowed_clients(tmp_path / "keys") == {key}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"short\n", ["line 1", "40 characters"]),
        (b"#\n" + b"%" * 40, ["line 2", "40 characters"]),
        (b"# ok\n" + b"\xff" * 40, ["no key file"]),
        (b"", ["holds no key"]),
    ],
)
def test_file_without_a_key_is_refused_with_its_name(
    tmp_path: Path, content: bytes, words: list[str]
) -> None:
    (tmp_path / "my.key").write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        read_keys(tmp_path / "my.key")
    for word in ("my.key", *words):
        assert word in str(caught.value)


def test_half_a_key_pair_is_none(tmp_path: Path) -> None:
    (tmp_path / "device.pub").write_text("of another key\n")
    with pytest.raises(OutputError, match=r"device\.pub: cannot be made"):
        make_key_pair(tmp_path / "device")
    assert [path.name for path in tmp_path.iterdir()] == ["device.pub"]
