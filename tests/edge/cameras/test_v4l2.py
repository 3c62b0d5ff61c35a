# SPDX-License-Identifier: Apache-2.0
import errno
import itertools
from collections.abc import Iterator
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from edge.cameras import v4l2_abi as abi
from edge.cameras.v4l2 import V4l2Camera
from edge.config.loader import load_struct
from edge.config.v4l2 import V4l2Config
from edge.errors import CameraLost, CameraRefused, ConfigError
from edge.geometry.camera import CameraModel
from edge.types import Frame
from tests.edge.cameras.device_tree import MadeTree
from tests.edge.cameras.scripted_kernel import (
    MONOTONIC_SOE,
    PERIOD_NS,
    START_NS,
    Control,
    Failure,
    Picture,
    ScriptedKernel,
    Unplugged,
    grey,
    pictures,
)

MODEL = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)
EXPOSURE = {
    abi.CID_EXPOSURE_AUTO: Control(0, 3, 3, allowed=(1, 3)),
    abi.CID_EXPOSURE_ABSOLUTE: Control(1, 5000, 157),
}


@pytest.fixture
def made(tmp_path: Path) -> MadeTree:
    made = MadeTree(tmp_path)
    made.plug("1.2", 0, "A1")
    return made


def _open(
    kernel: ScriptedKernel, made: MadeTree, *, colour: bool = False, **settings: object
) -> V4l2Camera:
    chosen = {"serial": "A1", "width": 64, "height": 48} | settings
    config = msgspec.convert(chosen, V4l2Config)
    return V4l2Camera(config, MODEL, kernel, made.tree, colour=colour)


def _frames(camera: V4l2Camera, count: int) -> list[Frame]:
    return list(itertools.islice(camera, count))


def _until_lost(camera: V4l2Camera) -> Iterator[Frame]:
    """Frames up to CameraLost, which must come."""
    with pytest.raises(CameraLost):
        yield from camera


def test_grey_frames_come_as_they_were_taken(made: MadeTree) -> None:
    kernel = ScriptedKernel(pictures(10))
    camera = _open(kernel, made)
    for index, frame in enumerate(_frames(camera, 10)):
        np.testing.assert_array_equal(frame.image, grey(index))
        assert frame.index == index
        assert frame.t_ns == pytest.approx(START_NS + (index + 1) * PERIOD_NS, abs=1000)
        assert not frame.image.flags.writeable
    assert camera.dropped == 0
    camera.close()
    assert not kernel.fds


def test_a_kept_image_survives_its_buffer(made: MadeTree) -> None:
    kept = _frames(_open(ScriptedKernel(pictures(12)), made, buffers=2), 12)
    for index, frame in enumerate(kept):
        np.testing.assert_array_equal(frame.image, grey(index))


def test_padded_rows_are_left_out(made: MadeTree) -> None:
    padded = np.pad(grey(0), ((0, 0), (0, 16)), constant_values=99)
    kernel = ScriptedKernel([Picture(padded.tobytes())], row_padding=16)
    np.testing.assert_array_equal(_frames(_open(kernel, made), 1)[0].image, grey(0))


def test_yuyv_gives_its_grey_bytes(made: MadeTree) -> None:
    packed = np.stack((grey(0), grey(1)), axis=-1)  # the second is colour
    kernel = ScriptedKernel([Picture(packed.tobytes())], sizes={"YUYV": (64, 48)})
    image = _frames(_open(kernel, made), 1)[0].image
    np.testing.assert_array_equal(image, grey(0))
    assert image.flags.c_contiguous


def _jpeg(seed: int) -> bytes:
    smooth = cv2.GaussianBlur(grey(seed), (0, 0), 4.0)
    return bytes(cv2.imencode(".jpg", smooth, [cv2.IMWRITE_JPEG_QUALITY, 95])[1])


def test_mjpg_is_decoded_and_what_is_cut_short_is_dropped(made: MadeTree) -> None:
    whole = _jpeg(0)
    script = [
        Picture(whole),
        Picture(whole[: len(whole) // 2]),
        Picture(b""),
        Picture(whole[:2] + b"garbage" + whole[-2:]),
        Picture(whole + b"\0\0\0"),  # drivers pad
    ]
    kernel = ScriptedKernel(script, sizes={"MJPG": (64, 48)})
    camera = _open(kernel, made)
    frames = _frames(camera, 2)
    assert [frame.index for frame in frames] == [0, 4]
    assert camera.dropped == 3
    expected = cv2.GaussianBlur(grey(0), (0, 0), 4.0)
    np.testing.assert_allclose(frames[1].image, expected, atol=6)  # [grey] of JPEG at 95


# Luma and chroma of a plain picture, and the colour that they are (BT.601).
PLAIN_YUV, PLAIN_RGB = (120, 60, 190), (220, 94, 0)


def _plain(name: str, padding: int) -> bytes:
    """A plain picture in a format, its rows padded."""
    y, u, v = PLAIN_YUV
    pad = bytes(padding)
    if name == "YUYV":
        return 48 * (32 * bytes((y, u, y, v)) + pad)
    if name == "NV12":
        return 48 * (64 * bytes((y,)) + pad) + 24 * (32 * bytes((u, v)) + pad)
    picture = np.full((48, 64, 3), PLAIN_RGB[::-1], np.uint8)
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1])


@pytest.mark.parametrize(("name", "padding"), [("YUYV", 0), ("YUYV", 8), ("NV12", 8), ("MJPG", 0)])
def test_colour_is_made_when_it_is_asked_for(made: MadeTree, name: str, padding: int) -> None:
    script = [Picture(_plain(name, padding)) for _ in range(4)]
    sizes = {"GREY": (64, 48), name: (64, 48)}  # grey, the first of the formats, gives way
    kernel = ScriptedKernel(script, sizes=sizes, row_padding=padding)
    camera = _open(kernel, made, buffers=2, colour=True)

    first, *_ = _frames(camera, 4)  # its buffer has been filled again

    assert first.colour is not None
    image = first.colour()
    assert image is not None
    assert image.shape == (48, 64, 3)
    np.testing.assert_allclose(image.reshape(-1, 3), np.tile(PLAIN_RGB, (48 * 64, 1)), atol=4)
    assert first.image.shape == (48, 64)
    if name != "MJPG":
        np.testing.assert_array_equal(first.image, PLAIN_YUV[0])


def test_a_grey_camera_has_no_colour_and_others_keep_none_unasked(made: MadeTree) -> None:
    (frame,) = _frames(_open(ScriptedKernel(pictures(1)), made, colour=True), 1)
    assert frame.colour is None
    kernel = ScriptedKernel([Picture(_plain("YUYV", 0))], sizes={"YUYV": (64, 48)})
    (frame,) = _frames(_open(kernel, made), 1)
    assert frame.colour is None


def test_grey_is_taken_before_yuyv_and_mjpg(made: MadeTree) -> None:
    sizes = {"MJPG": (64, 48), "YUYV": (64, 48), "GREY": (64, 48)}
    kernel = ScriptedKernel(pictures(1), sizes=sizes)
    np.testing.assert_array_equal(_frames(_open(kernel, made), 1)[0].image, grey(0))


def test_a_format_in_another_size_gives_way_to_one_in_the_right_size(made: MadeTree) -> None:
    packed = np.stack((grey(0), grey(1)), axis=-1)
    sizes = {"GREY": (32, 24), "YUYV": (64, 48)}
    kernel = ScriptedKernel([Picture(packed.tobytes())], sizes=sizes)
    np.testing.assert_array_equal(_frames(_open(kernel, made), 1)[0].image, grey(0))


def test_a_wrong_size_is_refused_with_what_there_is(made: MadeTree) -> None:
    kernel = ScriptedKernel([], sizes={"GREY": (32, 24), "H264": (64, 48)})
    with pytest.raises(
        CameraRefused, match=r"gives GREY 32x24, not GREY or YUYV or NV12 or MJPG in 64x48"
    ):
        _open(kernel, made)
    assert not kernel.fds


def test_a_calibration_of_another_size_is_refused(made: MadeTree) -> None:
    with pytest.raises(CameraRefused, match="calibration is for 64x48"):
        _open(ScriptedKernel([]), made, width=128)


def test_stamps_by_another_clock_are_refused(made: MadeTree) -> None:
    other = abi.BUF_FLAG_TSTAMP_SRC_SOE  # of an unknown clock
    camera = _open(ScriptedKernel(pictures(1, flags=other)), made)
    with pytest.raises(CameraRefused, match="does not stamp by the monotonic clock"):
        _frames(camera, 1)


def test_stamps_that_are_monotonic_by_name_only_are_refused(made: MadeTree) -> None:
    camera = _open(ScriptedKernel(pictures(1, stamp_offset_ns=10**18)), made)
    with pytest.raises(CameraRefused, match=r"stamps are \+1000000000\.0 s off"):
        _frames(camera, 1)


def test_damaged_buffers_are_dropped_and_come_back_to_the_driver(made: MadeTree) -> None:
    flags = MONOTONIC_SOE | abi.BUF_FLAG_ERROR
    whole = Picture(bytes(64 * 48), flags=flags)
    empty = Picture(b"", flags=flags, stamp_offset_ns=-(10**12))
    script = [item for good in pictures(10) for item in (good, whole, empty)]
    camera = _open(ScriptedKernel(script), made, buffers=2)
    frames = _frames(camera, 10)
    assert [frame.index for frame in frames] == list(range(0, 30, 3))
    assert camera.dropped == 18  # the last two were not asked for


def test_torn_images_are_dropped(made: MadeTree) -> None:
    script = [Picture(grey(0).tobytes()[:-1]), Picture(grey(1).tobytes())]
    camera = _open(ScriptedKernel(script), made)
    np.testing.assert_array_equal(_frames(camera, 1)[0].image, grey(1))
    assert camera.dropped == 1


def test_gaps_in_the_sequence_are_counted(made: MadeTree) -> None:
    first, second, third = pictures(3)
    script = [first, Picture(second.data, skipped=5), Picture(third.data, skipped=2)]
    camera = _open(ScriptedKernel(script), made)
    assert [frame.index for frame in _frames(camera, 3)] == [0, 6, 9]
    assert camera.dropped == 7


def test_the_sequence_may_wrap(made: MadeTree) -> None:
    kernel = ScriptedKernel(pictures(4))
    kernel.start_counting_at(0xFFFFFFFE)
    camera = _open(kernel, made)
    assert [frame.index for frame in _frames(camera, 4)] == [0xFFFFFFFE, 0xFFFFFFFF, 0, 1]
    assert camera.dropped == 0


def test_time_never_runs_backwards(made: MadeTree) -> None:
    script = pictures(3)
    script[1] = Picture(script[1].data, stamp_offset_ns=-3 * PERIOD_NS)
    camera = _open(ScriptedKernel(script), made)
    assert [frame.index for frame in _frames(camera, 2)] == [0, 2]
    assert camera.dropped == 1


@pytest.mark.parametrize(
    ("source", "shutter", "shift_us"),
    [
        (abi.BUF_FLAG_TSTAMP_SRC_SOE, "global", 5000),
        (abi.BUF_FLAG_TSTAMP_SRC_SOE, "rolling", 5000 + 4000),
        (abi.BUF_FLAG_TSTAMP_SRC_EOF, "global", -5000 - 8000),
        (abi.BUF_FLAG_TSTAMP_SRC_EOF, "rolling", -5000 - 4000),
    ],
)
def test_frames_are_stamped_at_mid_exposure(
    made: MadeTree, source: int, shutter: str, shift_us: int
) -> None:
    flags = abi.BUF_FLAG_TIMESTAMP_MONOTONIC | source
    kernel = ScriptedKernel(pictures(1, flags=flags), controls=dict(EXPOSURE))
    settings = {"exposure_us": 10_000, "readout_us": 8_000, "stamp_delay_us": 1_500}
    frame = _frames(_open(kernel, made, shutter=shutter, **settings), 1)[0]
    stamp_ns = (START_NS + PERIOD_NS) // 1000 * 1000
    assert frame.t_ns - stamp_ns == (shift_us - 1500) * 1000
    assert frame.exposure_ns == 10_000_000


def test_an_unplugged_camera_is_lost_and_leaves_nothing_open(made: MadeTree) -> None:
    kernel = ScriptedKernel([*pictures(3), Unplugged()])
    camera = _open(kernel, made)
    assert len(list(_until_lost(camera))) == 3
    camera.close()
    camera.close()
    assert not kernel.fds


def test_a_dequeue_that_says_no_device_is_a_loss(made: MadeTree) -> None:
    kernel = ScriptedKernel([*pictures(2), Failure(errno.ENODEV)])
    with pytest.raises(CameraLost, match="unplugged"):
        list(_open(kernel, made))


def test_a_few_failed_images_are_borne_many_in_a_row_are_a_loss(made: MadeTree) -> None:
    fail = Failure(errno.EIO)
    script = [*pictures(1), *[fail] * 9, *pictures(1), *[fail] * 9, *pictures(1), *[fail] * 10]
    camera = _open(ScriptedKernel(script), made)
    assert [frame.index for frame in _until_lost(camera)] == [0, 10, 20]
    assert camera.dropped == 18


def test_slow_images_are_waited_for_but_a_stall_is_a_loss(made: MadeTree) -> None:
    script = [*pictures(1), *pictures(1, late_s=1.5), *pictures(1, late_s=5.0)]
    kernel = ScriptedKernel(script)
    camera = _open(kernel, made, stall_s=2.0)
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
        _open(kernel, made)
    assert not kernel.fds


def test_a_device_that_may_not_be_opened_says_what_to_do(made: MadeTree) -> None:
    with pytest.raises(CameraLost, match="group video"):
        _open(ScriptedKernel([], open_error=errno.EACCES), made)


def test_a_node_of_metadata_is_refused(made: MadeTree) -> None:
    with pytest.raises(CameraRefused, match="video-index0"):
        _open(ScriptedKernel([], capabilities=0x00800000 | abi.CAP_STREAMING), made)


def test_the_rate_is_what_the_camera_agreed_to(
    made: MadeTree, caplog: pytest.LogCaptureFixture
) -> None:
    assert _open(ScriptedKernel([]), made, rate_hz=60).rate_hz == 60.0
    assert not caplog.records
    assert _open(ScriptedKernel([], fixed_rate=(1, 25)), made).rate_hz == 25.0
    assert "event=camera_rate" in caplog.text


def test_a_stopped_camera_ends(made: MadeTree) -> None:
    camera = _open(ScriptedKernel(pictures(5)), made)
    frames = iter(camera)
    next(frames)
    camera.stop()
    assert list(frames) == []


def test_an_exposure_longer_than_a_frame_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text("exposure_us = 40000.0")
    with pytest.raises(ConfigError, match="longer than a frame at 30 Hz: set 33333 or less"):
        load_struct(path, V4l2Config)


def test_an_automatic_exposure_is_followed(made: MadeTree) -> None:
    exposure = Control(1, 5000, 100, flags=abi.CTRL_FLAG_VOLATILE)
    controls = {
        abi.CID_EXPOSURE_AUTO: Control(0, 3, 3, allowed=(1, 3)),
        abi.CID_EXPOSURE_ABSOLUTE: exposure,
        abi.CID_GAIN: Control(0, 100, 10, flags=abi.CTRL_FLAG_VOLATILE),
    }
    kernel = ScriptedKernel(pictures(25), controls=controls)
    camera = _open(kernel, made, gain_db_per_step=0.5)
    frames = _frames(camera, 5)
    exposure.value = 200
    frames += _frames(camera, 20)
    assert {frame.exposure_ns for frame in frames[:10]} == {10_000_000}
    assert {frame.exposure_ns for frame in frames[10:]} == {20_000_000}
    assert {frame.gain_db for frame in frames} == {5.0}
    # Stamps are of the exposure's start: its middle moves with it.
    assert frames[10].t_ns - frames[9].t_ns == pytest.approx(PERIOD_NS + 5_000_000, abs=2000)


def test_what_a_driver_only_remembers_is_not_taken_for_the_exposure(made: MadeTree) -> None:
    kernel = ScriptedKernel(pictures(3), controls=dict(EXPOSURE))
    assert _frames(_open(kernel, made), 1)[0].exposure_ns is None


def test_a_fixed_gain_is_told_in_decibels(made: MadeTree) -> None:
    kernel = ScriptedKernel(pictures(3), controls={abi.CID_GAIN: Control(0, 100, 0)})
    camera = _open(kernel, made, gain=20, gain_db_per_step=0.3)
    assert _frames(camera, 1)[0].gain_db == pytest.approx(6.0)
