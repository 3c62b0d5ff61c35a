# SPDX-License-Identifier: Apache-2.0
import msgspec
import numpy as np

from edge.capture import format as format_
from edge.geometry import se3
from edge.outputs import capture_rows
from edge.types import Frame
from tests.edge.outputs.reports import odometry_pose, report


def test_poses_are_rows_that_viewers_draw() -> None:
    rows = dict(capture_rows.report_rows(report(7)))
    odometry = msgspec.json.decode(rows[format_.ODOMETRY])
    assert odometry["frame_id"] == "odom-1"
    x, y, z, *quaternion = se3.to_tum(odometry_pose(7))
    assert list(odometry["pose"]["position"].values()) == [x, y, z]
    assert list(odometry["pose"]["orientation"].values()) == quaternion
    in_map = msgspec.json.decode(rows[format_.POSE])
    assert in_map["frame_id"] == "map"
    assert len(in_map["covariance"]) == 21
    assert (in_map["timestamp"]["sec"], in_map["timestamp"]["nsec"]) == (0, 7 * 33_333_333)


def test_without_a_map_pose_there_is_no_row_of_it() -> None:
    topics = [topic for topic, _ in capture_rows.report_rows(report(7, published=False))]
    assert topics == [format_.STATE, format_.ODOMETRY]


def test_each_topic_of_rows_has_its_schema() -> None:
    for name, data in capture_rows.schemas().values():
        assert name
        assert msgspec.json.decode(data)["$ref"].startswith("#/$defs/")


def test_a_frame_row_tells_how_it_was_taken() -> None:
    frame = Frame(3, 5, np.zeros((2, 2), np.uint8), exposure_ns=7_000_000, gain_db=6.0)
    row = msgspec.json.decode(capture_rows.frame_row(frame))
    assert row == {"index": 3, "t_ns": 5, "exposure_ns": 7_000_000, "gain_db": 6.0}
