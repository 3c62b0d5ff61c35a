# SPDX-License-Identifier: Apache-2.0
import dataclasses
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest

from edge.geometry import se3, so3
from edge.outputs import wire
from edge.outputs.motion import Velocity
from edge.outputs.status import Facts, StatusTally
from tests.edge.outputs import reports

VELOCITY = Velocity(np.array([0.3, -0.2, 0.1]), np.array([0.0, 0.5, 0.0]), 0.01 * np.eye(6))


def messages() -> list[wire.Message]:
    report = reports.report(7)
    assert report.pose is not None
    tally = StatusTally(0)
    tally.add(report, 5)
    return [
        wire.pose_message(report, report.pose, VELOCITY, 3, 99),
        wire.odom_message(report, 4, 99),
        wire.odom_message(reports.lost(8), 5, 99),
        wire.fix_message(reports.fix(7), 0, 99),
        wire.fix_message(reports.fix(7, accepted=False), 1, 99),
        tally.message(2, 1_000_000, Facts(map="hall", reasons=("81 degrees",), level=2)),
        wire.WelcomeMessage(1, "0.1", "json", ("pose", "odom")),
    ]


@pytest.mark.parametrize("format_", ["msgpack", "json"])
@pytest.mark.parametrize("message", messages(), ids=lambda message: type(message).__name__)
def test_message_survives_the_wire(message: wire.Message, format_: wire.Format) -> None:
    topic, received = wire.decode(wire.encode(message, format_))
    assert wire.TOPICS[topic] is type(message)
    assert received == message


@pytest.mark.parametrize("format_", ["msgpack", "json"])
def test_what_is_unknown_arrives_as_nan(format_: wire.Format) -> None:
    report = reports.report(7)
    assert report.pose is not None
    pose = dataclasses.replace(report.pose, scale=float("nan"))
    message = wire.decode(wire.encode(wire.pose_message(report, pose, None, 0, 0), format_))[1]
    assert isinstance(message, wire.PoseMessage)
    assert message.T_map_cam_predicted is None
    unknown = (
        message.scale,
        *message.velocity_m_s,
        *message.angular_velocity_rad_s,
        *message.velocity_covariance,
    )
    assert len(unknown) == 1 + 3 + 3 + 21
    assert np.isnan(unknown).all()


def test_prediction_goes_on_for_the_poses_age() -> None:
    report = dataclasses.replace(reports.report(7), captured_ns=1_000_000_000)
    assert report.pose is not None
    message = wire.pose_message(report, report.pose, VELOCITY, 0, 1_200_000_000)
    assert message.age_ns == 200_000_000
    assert message.T_map_cam_predicted is not None
    for axis, speed in zip("xyz", VELOCITY.linear_m_s, strict=True):
        moved = getattr(message.T_map_cam_predicted, axis) - getattr(message.T_map_cam, axis)
        assert moved == pytest.approx(0.2 * speed)
    T = message.T_map_cam_predicted
    predicted = se3.from_tum([T.x, T.y, T.z, T.qx, T.qy, T.qz, T.qw])
    turned = so3.log(predicted[:3, :3] @ report.pose.T_map_cam[:3, :3].T)
    assert np.allclose(turned, 0.2 * VELOCITY.angular_rad_s, atol=1e-9)


@pytest.mark.parametrize("message", messages(), ids=lambda message: type(message).__name__)
def test_json_message_has_the_keys_and_kinds_of_the_schema(message: wire.Message) -> None:
    schema = wire.json_schema()
    topic, payload = wire.encode(message, "json").split(b" ", 1)
    assert_valid(msgspec.json.decode(payload), schema["topics"][topic.decode()], schema)


def test_unknown_values_fit_the_schema_too() -> None:
    report = reports.report(7)
    assert report.pose is not None
    message = wire.pose_message(report, report.pose, None, 0, 0)
    tree = msgspec.json.decode(wire.encode(message, "json").split(b" ", 1)[1])
    assert tree["velocity_m_s"] == [None, None, None]
    schema = wire.json_schema()
    assert_valid(tree, schema["topics"]["pose"], schema)
    with pytest.raises(AssertionError):
        assert_valid(tree | {"index": "7"}, schema["topics"]["pose"], schema)
    with pytest.raises(AssertionError):
        assert_valid(tree | {"sigma_m": None}, schema["topics"]["pose"], schema)


KINDS: dict[str, tuple[type, ...]] = {
    "integer": (int,),
    "number": (int, float),
    "string": (str,),
    "boolean": (bool,),
    "null": (type(None),),
    "array": (list,),
    "object": (dict,),
}


def assert_valid(value: Any, rule: dict[str, Any], schema: dict[str, Any]) -> None:
    """As much of JSON Schema as ours uses."""
    if "$ref" in rule:
        rule = schema["$defs"][rule["$ref"].rpartition("/")[2]]
    if "anyOf" in rule:
        alternatives = [option for option in rule["anyOf"] if _fits(value, option, schema)]
        assert alternatives, value
        return
    if "enum" in rule:
        assert value in rule["enum"]
        return
    names = [rule["type"]] if isinstance(rule["type"], str) else rule["type"]
    assert isinstance(value, tuple(kind for name in names for kind in KINDS[name])), (value, rule)
    if isinstance(value, list):
        inner = rule.get("prefixItems") or [rule["items"]] * len(value)
        assert len(inner) == len(value) >= rule.get("minItems", 0)
        assert len(value) <= rule.get("maxItems", len(value))
        for item, item_rule in zip(value, inner, strict=True):
            assert_valid(item, item_rule, schema)
    if isinstance(value, dict):
        assert set(rule["required"]) <= set(value)
        for key, item in value.items():
            assert_valid(item, rule["properties"][key], schema)


def _fits(value: Any, rule: dict[str, Any], schema: dict[str, Any]) -> bool:
    try:
        assert_valid(value, rule, schema)
    except AssertionError:
        return False
    return True


def test_no_topic_begins_another() -> None:
    heads = sorted(f"{topic} " for topic in wire.TOPICS)
    assert not any(longer.startswith(shorter) for shorter, longer in pairwise(heads))


def test_pose_on_the_wire_is_the_pose() -> None:
    report = reports.report(9)
    assert report.pose is not None
    sent = wire.pose_message(report, report.pose, None, 0, 0).T_map_cam
    row = [sent.x, sent.y, sent.z, sent.qx, sent.qy, sent.qz, sent.qw]
    assert np.allclose(se3.from_tum(row), report.pose.T_map_cam, atol=1e-12)


def test_covariance_is_the_upper_triangle_row_by_row() -> None:
    report = reports.report(1)
    assert report.pose is not None
    terms = wire.pose_message(report, report.pose, None, 0, 0).covariance
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
