# SPDX-License-Identifier: Apache-2.0
import errno
from pathlib import Path

import numpy as np
import pytest

from edge.cameras import v4l2_abi as abi
from edge.errors import CameraLost, CameraRefused
from tests.edge.cameras.device_tree import MadeTree
from tests.edge.cameras.scripted_kernel import (
    MONOTONIC_SOE,
    PERIOD_NS,
    START_NS,
    Failure,
    Picture,
    ScriptedKernel,
    Unplugged,
    grey,
    pictures,
)
from tests.edge.cameras.v4l2_opened import open_camera, plugged, take, until_lost


@pytest.fixture
def made(tmp_path: Path) -> MadeTree:
    return plugged(tmp_path)


def test_damaged_buffers_are_dropped_and_come_back_to_the_driver(made: MadeTree) -> None:
    flags = MONOTONIC_SOE | abi.BUF_FLAG_ERROR
    whole = Picture(bytes(64 * 48), flags=flags)
    empty = Picture(b"", flags=flags, stamp_offset_ns=-(10**12))
    script = [item for good in pictures(10) for item in (good, whole, empty)]
    camera = open_camera(ScriptedKernel(script), made, buffers=2)
    frames = take(camera, 10)
    assert [frame.index for frame in frames] == list(range(0, 30, 3))
    assert camera.dropped == 18  # the last two were not asked for


def test_torn_images_are_dropped(made: MadeTree) -> None:
    script = [Picture(grey(0).tobytes()[:-1]), Picture(grey(1).tobytes())]
    camera = open_camera(ScriptedKernel(script), made)
    np.testing.assert_array_equal(take(camera, 1)[0].image, grey(1))
    assert camera.dropped == 1


def test_gaps_in_the_sequence_are_counted(made: MadeTree) -> None:
    first, second, third = pictures(3)
    script = [first, Picture(second.data, skipped=5), Picture(third.data, skipped=2)]
    camera = open_camera(ScriptedKernel(script), made)
    assert [frame.index for frame in take(camera, 3)] == [0, 6, 9]
    assert camera.dropped == 7


def test_the_sequence_may_wrap(made: MadeTree) -> None:
    kernel = ScriptedKernel(pictures(4))
    kernel.start_counting_at(0xFFFFFFFE)
    camera = open_camera(kernel, made)
    assert [frame.index for frame in take(camera, 4)] == [0xFFFFFFFE, 0xFFFFFFFF, 0, 1]
    assert camera.dropped == 0


def test_time_never_runs_backwards(made: MadeTree) -> None:
    script = pictures(3)
    script[1] = Picture(script[1].data, stamp_offset_ns=-3 * PERIOD_NS)
    camera = open_camera(ScriptedKernel(script), made)
    assert [frame.index for frame in take(camera, 2)] == [0, 2]
    assert camera.dropped == 1


def test_an_unplugged_camera_is_lost_and_leaves_nothing_open(made: MadeTree) -> None:
    kernel = ScriptedKernel([*pictures(3), Unplugged()])
    camera = open_camera(kernel, made)
    assert len(list(until_lost(camera))) == 3
    camera.close()
    camera.close()
    assert not kernel.fds


def test_a_dequeue_that_says_no_device_is_a_loss(made: MadeTree) -> None:
    kernel = ScriptedKernel([*pictures(2), Failure(errno.ENODEV)])
    with pytest.raises(CameraLost, match="unplugged"):
        list(open_camera(kernel, made))


def test_a_few_failed_images_are_borne_many_in_a_row_are_a_loss(made: MadeTree) -> None:
    fail = Failure(errno.EIO)
    script = [*pictures(1), *[fail] * 9, *pictures(1), *[fail] * 9, *pictures(1), *[fail] * 10]
    camera = open_camera(ScriptedKernel(script), made)
    assert [frame.index for frame in until_lost(camera)] == [0, 10, 20]
    assert camera.dropped == 18


def test_slow_images_are_waited_for_but_a_stall_is_a_loss(made: MadeTree) -> None:
    script = [*pictures(1), *pictures(1, late_s=1.5), *pictures(1, late_s=5.0)]
    kernel = ScriptedKernel(script)
    camera = open_camera(kernel, made, stall_s=2.0)
    with pytest.raises(CameraLost, match="gave no image for 2 s"):
        list(camera)
    assert kernel.now_ns - START_NS == pytest.approx(1.5e9 + 2 * PERIOD_NS + 2.1e9, abs=2e8)


@pytest.mark.parametrize(
    ("request_", "number", "remedy"),
    [
        (abi.STREAMON, errno.ENOSPC, "USB bus is full"),
        (abi.S_FMT, errno.EBUSY, "end the other program"),
        (abi.REQBUFS, errno.ENOMEM, "Cannot allocate"),
        (abi.QUERYCAP, errno.ENOTTY, "no video device"),
    ],
)
def test_a_failing_start_says_what_to_do_and_closes(
    made: MadeTree, request_: int, number: int, remedy: str
) -> None:
    kernel = ScriptedKernel([], failing={request_: number})
    with pytest.raises(CameraLost, match=remedy):
        open_camera(kernel, made)
    assert not kernel.fds


def test_a_device_that_may_not_be_opened_says_what_to_do(made: MadeTree) -> None:
    with pytest.raises(CameraLost, match="group video"):
        open_camera(ScriptedKernel([], open_error=errno.EACCES), made)


def test_a_node_of_metadata_is_refused(made: MadeTree) -> None:
    with pytest.raises(CameraRefused, match="video-index0"):
        open_camera(ScriptedKernel([], capabilities=0x00800000 | abi.CAP_STREAMING), made)


def test_a_stopped_camera_ends(made: MadeTree) -> None:
    camera = open_camera(ScriptedKernel(pictures(5)), made)
    frames = iter(camera)
    next(frames)
    camera.stop()
    assert list(frames) == []
