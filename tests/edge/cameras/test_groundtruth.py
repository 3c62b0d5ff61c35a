# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.cameras import groundtruth
from edge.cameras.groundtruth import GroundTruth
from edge.errors import RecordingError
from edge.geometry import se3

S = 1_000_000_000


def moving() -> GroundTruth:
    """Truth at 0, 10, 20 ms and, after a gap, at 500 ms, turning at 1 rad/s."""
    t_ns = np.array([0, 10, 20, 500]) * 1_000_000
    return GroundTruth(t_ns, np.array([se3.exp([0, 0, 0, 0, t / S, 0]) for t in t_ns]))


@pytest.mark.parametrize("ms", [0, 5, 10, 17, 20, 500])
def test_pose_is_that_of_the_time(ms: int) -> None:
    pose = moving().pose_at(ms * 1_000_000)

    assert pose == pytest.approx(se3.exp([0, 0, 0, 0, ms / 1000, 0]), abs=1e-12)


@pytest.mark.parametrize("ms", [-30, -5, 30, 250, 490, 505, 600])
def test_there_is_no_pose_in_a_gap_or_beyond_the_ends(ms: int) -> None:
    assert moving().pose_at(ms * 1_000_000) is None


def test_a_gap_is_bridged_only_as_far_as_asked() -> None:
    truth = moving()

    assert truth.pose_at(260_000_000, max_dt_ns=240_000_000) is not None
    assert truth.pose_at(260_000_000, max_dt_ns=239_999_999) is None


def test_half_a_millisecond_beside_a_sample_is_that_sample() -> None:
    assert np.array_equal(moving().pose_at(-500_000), np.eye(4))


def test_samples_are_put_in_order_and_repeated_times_count_once(tmp_path: Path) -> None:
    path = tmp_path / "groundtruth.txt"
    path.write_text("2 2 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n1 9 0 0 0 0 0 1\n")
    truth = groundtruth.read_tum(path)

    assert truth.t_ns.tolist() == [S, 2 * S]
    assert truth.T_world_cam[:, 0, 3].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("# nothing\n", "holds no pose"),
        ("1 0 0 0 0 0 0 0\n", "quaternion of length 0"),
        ("1 0 0 0 0 0 0 2\n", "quaternion of length 2"),
        ("1 0 0 0 0 0 1\n", "line 1: has 7 columns"),
        ("1 0 0 0 0 0 nan 1\n", "line 1: .*finite"),
        ("1 0 0 0 a 0 0 1\n", "line 1: .*'a'"),
    ],
)
def test_a_bad_table_is_named(tmp_path: Path, text: str, word: str) -> None:
    path = tmp_path / "groundtruth.txt"
    path.write_text(text)

    with pytest.raises(RecordingError, match=word):
        groundtruth.read_tum(path)
