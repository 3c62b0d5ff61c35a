# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zmq

from edge.config.outputs import ZmqConfig
from edge.errors import OutputError
from edge.outputs import wire
from edge.outputs.status import Facts
from edge.outputs.zmq_pub import ZmqPublisher
from tests.edge.outputs import reports

ANY_PORT = ZmqConfig(endpoint="tcp://127.0.0.1:*", status_interval_s=0.05)
PATIENCE_MS = 60_000

Subscribe = Callable[[str, str], "zmq.Socket[bytes]"]


@pytest.fixture
def publisher() -> Iterator[ZmqPublisher]:
    publisher = ZmqPublisher(ANY_PORT)
    yield publisher
    publisher.close()


@pytest.fixture
def subscribe() -> Iterator[Subscribe]:
    context = zmq.Context()
    sockets = []

    def connect(endpoint: str, topic: str) -> "zmq.Socket[bytes]":
        socket = context.socket(zmq.SUB)
        sockets.append(socket)
        socket.rcvtimeo = PATIENCE_MS
        socket.subscribe(topic)  # before connecting, or the welcome may be missed
        socket.connect(endpoint)
        return socket

    yield connect
    for socket in sockets:
        socket.close(linger=0)
    context.term()


def write_until_heard(publisher: ZmqPublisher, socket: "zmq.Socket[bytes]") -> bytes:
    """The first message after the subscription has arrived at the publisher."""
    for index in range(PATIENCE_MS // 10):
        report = reports.report(index, fixes=(reports.fix(index),))
        publisher.write(replace(report, changes=(reports.change(index),)))
        while socket.poll(10):
            if not (frame := socket.recv()).startswith(b"welcome "):
                return frame
    raise AssertionError("nothing was heard")


def test_new_subscriber_is_told_the_schema_first(
    publisher: ZmqPublisher, subscribe: Subscribe
) -> None:
    socket = subscribe(publisher.endpoint, "welcome ")
    while not socket.poll(10):
        publisher.tick()
    topic, message = wire.decode(socket.recv())
    assert topic == "welcome"
    assert isinstance(message, wire.WelcomeMessage)
    assert message.schema == wire.SCHEMA_VERSION
    assert message.format == "msgpack"
    assert set(message.topics) == set(wire.TOPICS) - {"welcome"}


def test_status_comes_without_frames(publisher: ZmqPublisher, subscribe: Subscribe) -> None:
    socket = subscribe(publisher.endpoint, "status ")
    while not socket.poll(10):
        publisher.tick(lambda: Facts(camera="silent", reasons=("hot",)))
    message = wire.decode(socket.recv())[1]
    assert isinstance(message, wire.StatusMessage)
    assert (message.camera, message.reasons, message.frames) == ("silent", ("hot",), 0)
    assert not message.localised


def test_json_is_sent_where_it_is_asked_for(subscribe: Subscribe) -> None:
    config = msgspec.structs.replace(ANY_PORT, format="json")
    with closing(ZmqPublisher(config)) as publisher:
        frame = write_until_heard(publisher, subscribe(publisher.endpoint, "pose "))
    assert msgspec.json.decode(frame.partition(b" ")[2])["quality"] == 0.75


def test_velocity_is_sent_once_it_is_known(publisher: ZmqPublisher, subscribe: Subscribe) -> None:
    socket = subscribe(publisher.endpoint, "pose ")
    write_until_heard(publisher, socket)
    for index in range(1000, 1005):
        publisher.write(reports.report(index))
    message = wire.decode(socket.recv())[1]
    while message.t_ns != 1004 * reports.PERIOD_NS:
        message = wire.decode(socket.recv())[1]
    assert isinstance(message, wire.PoseMessage)
    speed = 0.01 * 1e9 / reports.PERIOD_NS  # along x, and the same around y
    assert 0.9 * speed < np.linalg.norm(message.velocity_m_s) < 1.3 * speed
    assert np.linalg.norm(message.angular_velocity_rad_s) == pytest.approx(speed, rel=0.01)
    assert message.T_map_cam_predicted is not None


def test_fuzzed_subscriptions_do_nothing(publisher: ZmqPublisher) -> None:
    context = zmq.Context()
    hostile = context.socket(zmq.XSUB)
    hostile.connect(publisher.endpoint)
    rng = np.random.default_rng(5)
    for _ in range(300):
        hostile.send(bytes([rng.integers(0, 4)]) + rng.bytes(int(rng.integers(0, 300))))
    hostile.send(b"\x01" + bytes(100_000))  # too large: the connection is cut
    friend = context.socket(zmq.SUB)
    friend.connect(publisher.endpoint)
    friend.subscribe("pose ")
    assert wire.decode(write_until_heard(publisher, friend))[0] == "pose"
    context.destroy(linger=0)


@pytest.mark.parametrize("topic", sorted(set(wire.TOPICS) - {"welcome"}))
def test_subscriber_hears_its_topic_alone(
    publisher: ZmqPublisher, subscribe: Subscribe, topic: str
) -> None:
    socket = subscribe(publisher.endpoint, topic + " ")
    heard = {wire.decode(write_until_heard(publisher, socket))[0] for _ in range(3)}
    assert heard == {topic}


def test_sequence_numbers_count_one_by_one(publisher: ZmqPublisher, subscribe: Subscribe) -> None:
    socket = subscribe(publisher.endpoint, "pose ")
    first = wire.decode(write_until_heard(publisher, socket))[1].seq
    for index in range(10):
        publisher.write(reports.report(index))
    later = [wire.decode(socket.recv())[1].seq for _ in range(10)]
    assert later == list(range(first + 1, first + 11))


def test_lost_frames_are_told_without_a_pose(publisher: ZmqPublisher, subscribe: Subscribe) -> None:
    socket = subscribe(publisher.endpoint, "")
    write_until_heard(publisher, socket)
    publisher.write(reports.lost(1000))
    topic, message = wire.decode(socket.recv())
    while message.t_ns != 1000 * reports.PERIOD_NS:
        topic, message = wire.decode(socket.recv())
    assert topic == "odom"
    assert isinstance(message, wire.OdomMessage)
    assert message.state == "lost"
    assert message.T_odom_cam is None


def test_newest_pose_is_whole_with_conflate(publisher: ZmqPublisher) -> None:
    context = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.conflate = True  # must be set before connecting
    socket.connect(publisher.endpoint)
    socket.subscribe("pose ")
    write_until_heard(publisher, socket)
    for index in range(100, 200):
        publisher.write(reports.report(index))
    socket.rcvtimeo = PATIENCE_MS
    message = wire.decode(socket.recv())[1]
    while message.index != 199:  # the newest always arrives, older ones maybe
        message = wire.decode(socket.recv())[1]
    assert isinstance(message, wire.PoseMessage)
    socket.close(linger=0)
    context.term()


def test_subscriber_that_never_reads_neither_stops_us_nor_fills_memory(
    subscribe: Subscribe, tmp_path: Path
) -> None:
    config = ZmqConfig(endpoint=f"ipc://{tmp_path}/poses", queue_messages=8)
    with closing(ZmqPublisher(config)) as publisher:
        socket = subscribe(config.endpoint, "pose ")
        write_until_heard(publisher, socket)
        for index in range(4000):  # a send that waits would do so for ever
            publisher.write(reports.report(index))
        kept = 0
        while socket.poll(50):
            socket.recv()
            kept += 1
    assert kept < 3000  # pipes and the reader's own queue hold some 1500


def test_port_in_use_is_one_line(publisher: ZmqPublisher) -> None:
    config = msgspec.structs.replace(ANY_PORT, endpoint=publisher.endpoint)
    with pytest.raises(OutputError, match=r"^outputs\.zmq\.endpoint tcp://127") as caught:
        ZmqPublisher(config)
    assert "\n" not in str(caught.value)
