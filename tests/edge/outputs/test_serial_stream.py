# SPDX-License-Identifier: Apache-2.0
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from edge.config.serial import SerialConfig
from edge.errors import ConfigError
from edge.geometry import so3
from edge.outputs.binary_frames import LOCALISED, POSE, POSE_LAYOUT, STATUS, STATUS_LAYOUT
from edge.outputs.report import FrameReport
from edge.outputs.serial_output import make_stream
from edge.outputs.serial_stream import SerialStream
from tests.edge.outputs import reports
from tests.edge.outputs.frame_decoder import unframe

common = pytest.importorskip("pymavlink.dialects.v20.common")
SECOND_NS = 1_000_000_000
LEVEL = np.eye(4).tolist()


def _stream(**settings: object) -> SerialStream:
    config = msgspec.convert(settings, SerialConfig)
    return make_stream(config, metric=True, T_local_map=LEVEL, map_name="hall")


def _drive(count: int, **more: object) -> Iterator[tuple[FrameReport, int]]:
    for index in range(count):
        yield reports.report(index, **more), index * reports.PERIOD_NS  # type: ignore[arg-type]


def _mavlink(data: bytes) -> list["common.MAVLink_message"]:
    return common.MAVLink(None).parse_buffer(data) or [] if data else []


def _kinds(data: bytes) -> list[int]:
    payloads = [unframe(piece) for piece in data.split(b"\0")[:-1]]
    return [payload[0] for payload in payloads if payload is not None]


def test_px4_gets_odometry_that_pymavlink_reads() -> None:
    stream = _stream(preset="px4")
    data = b"".join(stream.step(report, now_ns) for report, now_ns in _drive(8))
    messages = _mavlink(data)
    odometry = [message for message in messages if message.get_type() == "ODOMETRY"]
    assert len(odometry) == 8
    assert {message.get_srcComponent() for message in messages} == {197}
    last = odometry[-1]
    assert last.frame_id == common.MAV_FRAME_LOCAL_FRD
    assert last.child_frame_id == common.MAV_FRAME_BODY_FRD
    assert last.estimator_type != common.MAV_ESTIMATOR_TYPE_NAIVE  # PX4 ignores its covariance
    assert last.time_usec == 7 * reports.PERIOD_NS // 1000
    assert last.reset_counter == 2
    assert last.quality == 75
    pose = reports.report(7).pose
    assert pose is not None
    cam_axes_in_body = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    expected = np.diag([1.0, -1.0, -1.0]) @ pose.T_map_cam[:3, :3] @ cam_axes_in_body.T
    w, x, y, z = last.q
    np.testing.assert_allclose(so3.from_quaternion_xyzw([x, y, z, w]), expected, atol=1e-6)
    assert np.isnan(odometry[0].vx)  # one pose tells no velocity
    assert np.isnan(odometry[0].velocity_covariance[0])
    assert np.isfinite([last.vx, last.vy, last.vz, *last.velocity_covariance]).all()


def test_ardupilot_gets_positions_without_a_nan() -> None:
    stream = _stream(preset="ardupilot")
    data = b"".join(stream.step(report, now_ns) for report, now_ns in _drive(8))
    poses = [x for x in _mavlink(data) if x.get_type() == "VISION_POSITION_ESTIMATE"]
    assert len(poses) == 8
    first, pose = poses[0], reports.report(0).pose
    assert pose is not None
    p = pose.T_map_cam[:3, 3]
    np.testing.assert_allclose([first.x, first.y, first.z], [p[0], -p[1], -p[2]], rtol=1e-6)
    assert np.isfinite([first.roll, first.pitch, first.yaw, *first.covariance]).all()


def test_a_known_heading_is_called_ned() -> None:
    stream = _stream(preset="px4", map_heading_deg=0.0)
    message = _mavlink(stream.step(reports.report(0), 0))[0]
    assert message.frame_id == common.MAV_FRAME_LOCAL_NED


def test_roll_pitch_and_yaw_rebuild_the_rotation() -> None:
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    identity = np.eye(4).tolist()
    stream = make_stream(
        SerialConfig(preset="ardupilot", rate_hz=100.0, T_body_cam=identity),
        metric=True,
        T_local_map=LEVEL,
        map_name="hall",
    )
    for report, now_ns in _drive(20):
        assert report.pose is not None
        message = _mavlink(stream.step(report, now_ns))[0]
        R = rotation.from_euler("ZYX", [message.yaw, message.pitch, message.roll]).as_matrix()
        expected = np.diag([1.0, -1.0, -1.0]) @ report.pose.T_map_cam[:3, :3]
        np.testing.assert_allclose(R, expected, atol=1e-6)


def test_a_lost_camera_is_silent_but_for_its_heartbeat() -> None:
    stream = _stream()
    data = b"".join(
        stream.step(reports.lost(index), index * reports.PERIOD_NS) for index in range(91)
    )
    kinds = [message.get_type() for message in _mavlink(data)]
    assert kinds == ["HEARTBEAT", "STATUSTEXT", "HEARTBEAT", "HEARTBEAT", "HEARTBEAT"]


def test_loss_and_return_are_told_to_the_operator_once_each() -> None:
    stream = _stream()
    texts: list[str] = []
    for index in range(300):
        here = index < 100 or index >= 200
        report = reports.report(index) if here else reports.lost(index)
        for message in _mavlink(stream.step(report, index * reports.PERIOD_NS)):
            texts += [message.text] if message.get_type() == "STATUSTEXT" else []
    assert texts == ["mapvo: localised", "mapvo: lost, no poses", "mapvo: localised"]


def test_a_camera_that_gives_no_frames_is_not_localised() -> None:
    stream = _stream()
    stream.step(reports.report(0), 0)
    data = b"".join(stream.step(None, second * SECOND_NS) for second in range(1, 4))
    states = [m.system_status for m in _mavlink(data) if m.get_type() == "HEARTBEAT"]
    assert states == [4, 3, 3]


@pytest.mark.parametrize(("rate_hz", "expected"), [(30.0, 300), (10.0, 100), (7.0, 70)])
def test_poses_keep_to_their_rate(rate_hz: float, expected: int) -> None:
    rng = np.random.default_rng(0)
    stream = _stream(protocol="binary", rate_hz=rate_hz)
    kinds: list[int] = []
    for report, now_ns in _drive(300):
        jitter_ns = int(rng.uniform(-5e6, 5e6))  # of a camera's arrival
        kinds += _kinds(stream.step(report, SECOND_NS + now_ns + jitter_ns))
    assert kinds.count(POSE) == pytest.approx(expected, abs=2)
    assert kinds.count(STATUS) == pytest.approx(10, abs=1)


def test_binary_frames_carry_the_level_pose_and_what_the_map_is() -> None:
    lifted = np.eye(4)
    lifted[2, 3] = 10.0
    stream = make_stream(
        SerialConfig(protocol="binary"),
        metric=False,
        T_local_map=lifted.tolist(),
        map_name="hall",
    )
    report = reports.report(0)
    assert report.pose is not None
    pose, status = (unframe(piece) for piece in stream.step(report, 0).split(b"\0")[:-1])
    assert pose is not None
    assert status is not None
    numbers = POSE_LAYOUT.unpack(pose)
    np.testing.assert_allclose(numbers[9:12], report.pose.T_map_cam[:3, 3] + [0, 0, 10], rtol=1e-6)
    assert numbers[3] == LOCALISED | 4
    assert numbers[8] == 4000  # [us] of 4 ms latency
    assert STATUS_LAYOUT.unpack(status)[-2:] == (1, 1)


@pytest.mark.parametrize("protocol", ["binary", "ascii"])
def test_other_protocols_take_a_map_as_it_is(protocol: str) -> None:
    config = msgspec.convert({"protocol": protocol}, SerialConfig)
    stream = make_stream(config, metric=False, T_local_map=None, map_name="hall")
    assert stream.step(reports.report(0), 0)


def test_mavlink_refuses_a_map_without_metres() -> None:
    with pytest.raises(ConfigError, match="no metric scale"):
        make_stream(SerialConfig(), metric=False, T_local_map=LEVEL, map_name="hall")


def test_notice_is_text_for_the_operator_and_nothing_for_machines() -> None:
    text = "hall-7 refused: " + 60 * "x"
    (message,) = common.MAVLink(None).parse_buffer(_stream().tell(text))
    assert message.get_type() == "STATUSTEXT"
    assert message.text == f"mapvo: {text}"[:50]
    for protocol in ("binary", "ascii"):
        assert _stream(protocol=protocol).tell(text) == b""
