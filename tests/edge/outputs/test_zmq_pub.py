import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import msgspec
import pytest
import zmq

from edge.config.outputs import ZmqConfig
from edge.errors import OutputError
from edge.outputs import wire
from edge.outputs.zmq_pub import ZmqPublisher
from tests.edge.outputs import reports

ANY_PORT = ZmqConfig(endpoint="tcp://127.0.0.1:*", status_interval_s=0.05)
PATIENCE_MS = 5000

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
        socket.connect(endpoint)
        socket.subscribe(topic)
        return socket

    yield connect
    for socket in sockets:
        socket.close(linger=0)
    context.term()


def write_until_heard(publisher: ZmqPublisher, socket: "zmq.Socket[bytes]") -> bytes:
    """The first message after the subscription has arrived at the publisher."""
    for index in range(PATIENCE_MS // 10):
        publisher.write(reports.report(index, fixes=(reports.fix(index),)))
        if socket.poll(10):
            return socket.recv()
    raise AssertionError("nothing was heard")


@pytest.mark.parametrize("topic", sorted(wire.TOPICS))
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
    time.sleep(0.1)
    message = wire.decode(socket.recv())[1]
    socket.close(linger=0)
    context.term()
    assert isinstance(message, wire.PoseMessage)
    assert message.index == 199


def test_subscriber_that_never_reads_neither_stops_us_nor_fills_memory(
    subscribe: Subscribe, tmp_path: Path
) -> None:
    config = ZmqConfig(endpoint=f"ipc://{tmp_path}/poses", queue_messages=8)
    with closing(ZmqPublisher(config)) as publisher:
        socket = subscribe(config.endpoint, "pose ")
        write_until_heard(publisher, socket)
        began = time.monotonic()
        for index in range(4000):
            publisher.write(reports.report(index))
        assert time.monotonic() - began < 4.0  # 1 ms a frame: no send has waited
        time.sleep(0.1)
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
