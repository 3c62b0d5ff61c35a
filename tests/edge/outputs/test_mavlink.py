# SPDX-License-Identifier: Apache-2.0
"""The encoder against pymavlink's, byte by byte."""

import numpy as np
import pytest

from edge.config import serial as budget
from edge.outputs import mavlink

common = pytest.importorskip("pymavlink.dialects.v20.common")


class _Sink:
    def __init__(self) -> None:
        self.data = b""

    def write(self, data: bytes) -> None:
        self.data += data


@pytest.fixture
def oracle() -> "common.MAVLink":
    return common.MAVLink(_Sink(), srcSystem=7, srcComponent=197)


@pytest.fixture
def encoder() -> mavlink.Encoder:
    return mavlink.Encoder(7, 197)


def _numbers(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, 3.0, count)


@pytest.mark.parametrize("unknown_velocity", [False, True])
def test_odometry_is_what_pymavlink_sends(encoder, oracle, unknown_velocity: bool) -> None:
    x, q, v, w = _numbers(1, 3), _numbers(2, 4), _numbers(3, 3), _numbers(4, 3)
    pose_covariance, velocity_covariance = _numbers(5, 21), _numbers(6, 21)
    if unknown_velocity:
        v[:], w[:] = np.nan, np.nan
        velocity_covariance = np.array([np.nan] + 20 * [0.0])
    ours = encoder.odometry(
        mavlink.Odometry(
            123_456_789_012,
            mavlink.FRAME_LOCAL_FRD,
            x,
            q,
            v,
            w,
            pose_covariance,
            velocity_covariance,
            reset_counter=255,
            quality_percent=75,
        )
    )
    oracle.odometry_send(
        123_456_789_012,
        common.MAV_FRAME_LOCAL_FRD,
        common.MAV_FRAME_BODY_FRD,
        *x,
        list(q),
        *v,
        *w,
        list(pose_covariance),
        list(velocity_covariance),
        reset_counter=255,
        estimator_type=common.MAV_ESTIMATOR_TYPE_VISION,
        quality=75,
    )
    assert ours == oracle.file.data
    assert len(ours) == budget.ODOMETRY_BYTES


@pytest.mark.parametrize("resets", [0, 3])
def test_vision_position_estimate_is_what_pymavlink_sends(encoder, oracle, resets: int) -> None:
    x, angles, covariance = _numbers(1, 3), _numbers(2, 3), _numbers(3, 21)
    if resets == 0:
        covariance[10:] = 0.0  # truncation reaches into the covariance
    ours = encoder.vision_position_estimate(
        mavlink.VisionPositionEstimate(99, x, angles, covariance, resets)
    )
    oracle.vision_position_estimate_send(99, *x, *angles, list(covariance), resets)
    assert ours == oracle.file.data
    assert len(ours) <= budget.VISION_POSITION_ESTIMATE_BYTES
    assert (len(ours) == budget.VISION_POSITION_ESTIMATE_BYTES) == (resets > 0)


def test_heartbeat_is_what_pymavlink_sends(encoder, oracle) -> None:
    ours = encoder.heartbeat(mavlink.STATE_ACTIVE)
    oracle.heartbeat_send(
        common.MAV_TYPE_ONBOARD_CONTROLLER,
        common.MAV_AUTOPILOT_INVALID,
        0,
        0,
        common.MAV_STATE_ACTIVE,
    )
    assert ours == oracle.file.data
    assert len(ours) == budget.HEARTBEAT_BYTES


@pytest.mark.parametrize("text", ["", "mapvo: lost", 50 * "x"])
def test_statustext_is_what_pymavlink_sends(encoder, oracle, text: str) -> None:
    oracle.statustext_send(mavlink.SEVERITY_WARNING, text.encode())
    ours = encoder.statustext(mavlink.SEVERITY_WARNING, text)
    assert ours == oracle.file.data
    assert len(ours) <= budget.STATUSTEXT_BYTES


def test_statustext_is_cut_at_50_characters(encoder) -> None:
    assert len(encoder.statustext(mavlink.SEVERITY_INFO, 80 * "y")) == 12 + 51


def test_an_all_zero_payload_keeps_one_byte(encoder, oracle) -> None:
    zeros = np.zeros(21)
    ours = encoder.vision_position_estimate(
        mavlink.VisionPositionEstimate(0, zeros[:3], zeros[:3], zeros, 0)
    )
    oracle.vision_position_estimate_send(0, *zeros[:6], list(zeros), 0)
    assert ours == oracle.file.data
    assert ours[1] == 1


def test_the_sequence_counts_all_messages_and_wraps(encoder) -> None:
    sequences = [encoder.heartbeat(4)[4] for _ in range(257)]
    assert sequences == [*range(256), 0]


def test_pymavlink_reads_a_stream_of_all_messages(encoder) -> None:
    stream = encoder.heartbeat(4) + encoder.statustext(6, "mapvo: localised")
    parser = common.MAVLink(None)
    parser.robust_parsing = False
    messages = parser.parse_buffer(stream)
    assert [message.get_type() for message in messages] == ["HEARTBEAT", "STATUSTEXT"]
    assert messages[1].text == "mapvo: localised"
    assert messages[0].get_srcComponent() == 197


def test_the_checksum_is_the_published_one() -> None:
    # CRC-16/MCRF4XX's check value in the catalogue of CRC algorithms.
    assert mavlink.checksum(b"123456789") == 0x6F91
