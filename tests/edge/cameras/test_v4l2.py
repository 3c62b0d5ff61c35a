# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.errors import CameraRefused
from tests.edge.cameras.device_tree import MadeTree
from tests.edge.cameras.scripted_kernel import (
    PERIOD_NS,
    START_NS,
    Picture,
    ScriptedKernel,
    grey,
    pictures,
)
from tests.edge.cameras.v4l2_opened import open_camera, plugged, take


@pytest.fixture
def made(tmp_path: Path) -> MadeTree:
    return plugged(tmp_path)


def test_grey_frames_come_as_they_were_taken(made: MadeTree) -> None:
    kernel = ScriptedKernel(pictures(10))
    camera = open_camera(kernel, made)
    for index, frame in enumerate(take(camera, 10)):
        np.testing.assert_array_equal(frame.image, grey(index))
        assert frame.index == index
        assert frame.t_ns == pytest.approx(START_NS + (index + 1) * PERIOD_NS, abs=1000)
        assert not frame.image.flags.writeable
    assert camera.dropped == 0
    camera.close()
    assert not kernel.fds


def test_a_kept_image_survives_its_buffer(made: MadeTree) -> None:
    kept = take(open_camera(ScriptedKernel(pictures(12)), made, buffers=2), 12)
    for index, frame in enumerate(kept):
        np.testing.assert_array_equal(frame.image, grey(index))


def test_padded_rows_are_left_out(made: MadeTree) -> None:
    padded = np.pad(grey(0), ((0, 0), (0, 16)), constant_values=99)
    kernel = ScriptedKernel([Picture(padded.tobytes())], row_padding=16)
    np.testing.assert_array_equal(take(open_camera(kernel, made), 1)[0].image, grey(0))


def test_yuyv_gives_its_grey_bytes(made: MadeTree) -> None:
    packed = np.stack((grey(0), grey(1)), axis=-1)  # the second is colour
    kernel = ScriptedKernel([Picture(packed.tobytes())], sizes={"YUYV": (64, 48)})
    image = take(open_camera(kernel, made), 1)[0].image
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
    camera = open_camera(kernel, made)
    frames = take(camera, 2)
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
    camera = open_camera(kernel, made, buffers=2, colour=True)

    first, *_ = take(camera, 4)  # its buffer has been filled again

    assert first.colour is not None
    image = first.colour()
    assert image is not None
    assert image.shape == (48, 64, 3)
    np.testing.assert_allclose(image.reshape(-1, 3), np.tile(PLAIN_RGB, (48 * 64, 1)), atol=4)
    assert first.image.shape == (48, 64)
    if name != "MJPG":
        np.testing.assert_array_equal(first.image, PLAIN_YUV[0])


def test_a_grey_camera_has_no_colour_and_others_keep_none_unasked(made: MadeTree) -> None:
    (frame,) = take(open_camera(ScriptedKernel(pictures(1)), made, colour=True), 1)
    assert frame.colour is None
    kernel = ScriptedKernel([Picture(_plain("YUYV", 0))], sizes={"YUYV": (64, 48)})
    (frame,) = take(open_camera(kernel, made), 1)
    assert frame.colour is None


def test_grey_is_taken_before_yuyv_and_mjpg(made: MadeTree) -> None:
    sizes = {"MJPG": (64, 48), "YUYV": (64, 48), "GREY": (64, 48)}
    kernel = ScriptedKernel(pictures(1), sizes=sizes)
    np.testing.assert_array_equal(take(open_camera(kernel, made), 1)[0].image, grey(0))


def test_a_format_in_another_size_gives_way_to_one_in_the_right_size(made: MadeTree) -> None:
    packed = np.stack((grey(0), grey(1)), axis=-1)
    sizes = {"GREY": (32, 24), "YUYV": (64, 48)}
    kernel = ScriptedKernel([Picture(packed.tobytes())], sizes=sizes)
    np.testing.assert_array_equal(take(open_camera(kernel, made), 1)[0].image, grey(0))


def test_a_wrong_size_is_refused_with_what_there_is(made: MadeTree) -> None:
    kernel = ScriptedKernel([], sizes={"GREY": (32, 24), "H264": (64, 48)})
    with pytest.raises(
        CameraRefused, match=r"gives GREY 32x24, not GREY or YUYV or NV12 or MJPG in 64x48"
    ):
        open_camera(kernel, made)
    assert not kernel.fds


def test_a_calibration_of_another_size_is_refused(made: MadeTree) -> None:
    with pytest.raises(CameraRefused, match="calibration is for 64x48"):
        open_camera(ScriptedKernel([]), made, width=128)
