# SPDX-License-Identifier: Apache-2.0
"""Images out of a driver's buffers, and the time at which they were exposed."""

import mmap
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from edge.cameras import v4l2_abi as abi
from edge.cameras.v4l2_stream import Filled, PixelFormat
from edge.config.v4l2 import V4l2Config
from edge.types import U8

_JPEG_END = b"\xff\xd9"


def read_grey(memory: mmap.mmap, used_bytes: int, form: PixelFormat) -> U8 | None:
    """Image (h, w) uint8 of its own memory, read-only; None where the buffer is incomplete.

    One pass over the bytes: the driver gets its buffer back at once, whoever keeps the image.
    """
    image = _decode(memory, used_bytes) if form.name == "MJPG" else _copy(memory, used_bytes, form)
    if image is None or image.shape != (form.height, form.width):
        return None
    image.flags.writeable = False
    return image


def colour_reader(
    memory: mmap.mmap, used_bytes: int, form: PixelFormat
) -> Callable[[], U8 | None] | None:
    """What makes the image (h, w, 3) of a buffer, red first, when it is asked for.

    It holds a copy of the bytes, as the driver fills the buffer again; None for a grey camera.
    """
    if form.name == "GREY":
        return None
    needed = used_bytes if form.name == "MJPG" else form.image_bytes
    return partial(_colour, memory[:needed], form)


def _colour(data: bytes, form: PixelFormat) -> U8 | None:
    stored: U8 = np.frombuffer(data, np.uint8)
    if form.name == "MJPG":
        try:
            image = cv2.imdecode(stored, cv2.IMREAD_COLOR)
        except cv2.error:
            return None
        if image is None or image.shape[:2] != (form.height, form.width):
            return None
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
    if len(data) < form.image_bytes:
        return None
    if form.name == "YUYV":
        shape, strides = (form.height, form.width, 2), (form.row_bytes, 2, 1)
        pairs: U8 = np.ndarray(shape, np.uint8, data, strides=strides)
        packed = np.ascontiguousarray(pairs)
        return np.asarray(cv2.cvtColor(packed, cv2.COLOR_YUV2RGB_YUY2), np.uint8)
    rows = form.height + form.height // 2
    plane: U8 = np.ndarray((rows, form.width), np.uint8, data, strides=(form.row_bytes, 1))
    packed = np.ascontiguousarray(plane)
    return np.asarray(cv2.cvtColor(packed, cv2.COLOR_YUV2RGB_NV12), np.uint8)


def mid_exposure_ns(filled: Filled, exposure_ns: int, config: V4l2Config) -> int:
    """When the middle of the image was exposed, from what the driver says that its stamp is.

    A rolling shutter exposes the middle row half a read-out after the first.
    """
    rolling = config.shutter == "rolling"
    readout_ns = config.readout_us * 1e3
    if filled.flags & abi.BUF_FLAG_TSTAMP_SRC_MASK == abi.BUF_FLAG_TSTAMP_SRC_SOE:
        shift_ns = 0.5 * exposure_ns + (0.5 * readout_ns if rolling else 0.0)
    else:  # the end of the last row's read-out
        shift_ns = -0.5 * exposure_ns - (0.5 if rolling else 1.0) * readout_ns
    return round(filled.stamp_ns - config.stamp_delay_us * 1e3 + shift_ns)


def _copy(memory: mmap.mmap, used_bytes: int, form: PixelFormat) -> U8 | None:
    """The grey bytes; of YUYV every second one."""
    if used_bytes < form.image_bytes or len(memory) < form.image_bytes:
        return None
    per_pixel = 2 if form.name == "YUYV" else 1
    plane: U8 = np.ndarray(
        (form.height, form.width), np.uint8, memory, strides=(form.row_bytes, per_pixel)
    )
    return plane.copy()


def _decode(memory: mmap.mmap, used_bytes: int) -> U8 | None:
    """The grey part of a JPEG; of one cut short OpenCV 4 would invent the rest."""
    data = memory[:used_bytes]
    if not data.startswith(b"\xff\xd8") or not data.rstrip(b"\0").endswith(_JPEG_END):
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, np.uint8)
