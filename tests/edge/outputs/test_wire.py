from itertools import pairwise

import msgspec
import numpy as np
import pytest

from edge.geometry import se3
from edge.outputs import wire
from tests.edge.outputs import reports


def messages() -> list[wire.Message]:
    report = reports.report(7)
    assert report.pose is not None
    return [
        wire.pose_message(report, report.pose, 3, 99),
        wire.odom_message(report, 4, 99),
        wire.odom_message(reports.lost(8), 5, 99),
        wire.fix_message(reports.fix(7), 0, 99),
        wire.fix_message(reports.fix(7, accepted=False), 1, 99),
    ]


@pytest.mark.parametrize("message", messages(), ids=lambda message: type(message).__name__)
def test_message_survives_the_wire(message: wire.Message) -> None:
    topic, received = wire.decode(wire.encode(message))
    assert wire.TOPICS[topic] is type(message)
    assert received == message


def test_no_topic_begins_another() -> None:
    heads = sorted(f"{topic} " for topic in wire.TOPICS)
    assert not any(longer.startswith(shorter) for shorter, longer in pairwise(heads))


def test_pose_on_the_wire_is_the_pose() -> None:
    report = reports.report(9)
    assert report.pose is not None
    sent = wire.pose_message(report, report.pose, 0, 0).T_map_cam
    row = [sent.x, sent.y, sent.z, sent.qx, sent.qy, sent.qz, sent.qw]
    assert np.allclose(se3.from_tum(row), report.pose.T_map_cam, atol=1e-12)


def test_covariance_is_the_upper_triangle_row_by_row() -> None:
    report = reports.report(1)
    assert report.pose is not None
    terms = wire.pose_message(report, report.pose, 0, 0).covariance
    C = report.pose.covariance
    assert len(terms) == 21
    assert terms[:7] == (C[0, 0], C[0, 1], C[0, 2], C[0, 3], C[0, 4], C[0, 5], C[1, 1])


def test_newer_message_with_more_keys_is_read() -> None:
    frame = wire.encode(messages()[1])
    tree = msgspec.msgpack.decode(frame.partition(b" ")[2]) | {"schema": 2, "colour": "red"}
    topic, message = wire.decode(b"odom " + msgspec.msgpack.encode(tree))
    assert topic == "odom"
    assert message.schema == 2


@pytest.mark.parametrize("message", messages()[:1])
def test_truncated_message_is_refused_at_every_byte(message: wire.Message) -> None:
    frame = wire.encode(message)
    for length in range(len(frame)):
        with pytest.raises(wire.WireError):
            wire.decode(frame[:length])


@pytest.mark.parametrize("seed", range(20))
def test_noise_is_refused(seed: int) -> None:
    noise = np.random.default_rng(seed).bytes(200)
    for head in (b"", b"pose ", b"status "):
        with pytest.raises(wire.WireError):
            wire.decode(head + noise)
