# SPDX-License-Identifier: Apache-2.0
"""Image files, whole or refused: a decoder fills what a truncated file lacks with grey."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edge.cameras.layout import ImageFile
from edge.errors import RecordingError
from edge.types import F32, U8

# Some writers pad a JPEG or append notes; its end marker is looked for in this many bytes.
_JPEG_TAIL = 4096


def read_grey(path: ImageFile) -> U8:
    """Image (h, w) uint8; colour becomes luma."""
    grey: U8 = _decode(path, cv2.IMREAD_GRAYSCALE)
    return grey


def read_rgb(path: ImageFile) -> U8:
    """Image (h, w, 3) uint8, red first."""
    rgb: U8 = cv2.cvtColor(_decode(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    return rgb


def read_depth(path: Path, metres_per_unit: float) -> F32:
    """Depth along z (h, w) float32 [m] of a 16-bit image, 0 where it is unknown."""
    raw = _decode(path, cv2.IMREAD_UNCHANGED)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise RecordingError(f"{path}: is no 16-bit grey image; write depth as 16-bit PNG")
    depth_m: F32 = raw.astype(np.float32) * np.float32(metres_per_unit)
    return depth_m


def check_size(path: ImageFile, image: U8 | F32, width: int, height: int) -> None:
    """Refuse an image of another size than its camera's."""
    if image.shape[:2] != (height, width):
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise RecordingError(f"{path}: is {size}, its camera is {width}x{height}")


def is_file(path: Path) -> bool:
    """Whether there is such a file; a name that no file can have is of none."""
    try:
        return path.is_file()
    except OSError:
        return False


def read_bytes(path: ImageFile) -> bytes:
    """All bytes of a file, some at least."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise RecordingError(f"{path}: is missing") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise RecordingError(f"{str(path)!r}: cannot be read: {error}") from None
    if not data:
        raise RecordingError(f"{path}: is empty")
    return data


def _decode(path: ImageFile, flags: int) -> Any:  # cv2 has no types here
    data = read_bytes(path)
    if _is_cut_short(data):
        raise RecordingError(f"{path}: is cut short")
    if flags != cv2.IMREAD_UNCHANGED:
        # A camera is calibrated as its sensor lies, however it was held at this image.
        flags |= cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        raise RecordingError(f"{path}: is no image that can be decoded")
    return image


def _is_cut_short(data: bytes) -> bool:
    """Tell whether a JPEG or PNG lacks its end."""
    if data.startswith(b"\xff\xd8"):
        # Inside a scan 0xff is stuffed, so that the pair is a marker; a thumbnail's own end
        # comes before the scan of the image.
        end = data.rfind(b"\xff\xd9")
        return end < max(len(data) - _JPEG_TAIL, data.rfind(b"\xff\xda"))
    if data.startswith(b"\x89PNG"):
        return not _has_all_chunks(data)
    return False


def _has_all_chunks(png: bytes) -> bool:
    """Tell whether the chunks follow each other to the last.

    OpenCV takes as much memory as a chunk's length says (4 GB), however short the file is.
    """
    at = len(b"\x89PNG\r\n\x1a\n")
    while at + 12 <= len(png):
        if png[at + 4 : at + 8] == b"IEND":
            return True
        at += 12 + int.from_bytes(png[at : at + 4], "big")
    return False
