# SPDX-License-Identifier: Apache-2.0
import struct

import cv2
import numpy as np
import pytest

from edge.capture import format as format_
from edge.errors import RecordingError
from tests.edge.capture.captures import CAMERA, header, picture

T_NS = 1_403_715_273_262_142_976


class Cdr:
    """Reads CDR by its rules alone: each number aligned to its size behind the 4-byte head."""

    def __init__(self, data: bytes) -> None:
        assert data[:4] == b"\x00\x01\x00\x00"
        self._data, self._at = data[4:], 0

    def number(self, code: str) -> int:
        size = struct.calcsize(code)
        self._at += -self._at % size
        (value,) = struct.unpack_from("<" + code, self._data, self._at)
        self._at += size
        return int(value)

    def string(self) -> str:
        text = self.octets()
        assert text.endswith(b"\0")
        return text[:-1].decode()

    def octets(self) -> bytes:
        length = self.number("I")
        self._at += length
        assert self._at <= len(self._data)
        return self._data[self._at - length : self._at]

    def at_end(self) -> bool:
        return self._at == len(self._data)


def test_a_png_message_is_a_ros_compressed_image() -> None:
    cdr = Cdr(format_.encode_png(T_NS, picture(1)))
    assert (cdr.number("i"), cdr.number("I")) == divmod(T_NS, 10**9)
    assert (cdr.string(), cdr.string()) == ("cam", "png")
    decoded = cv2.imdecode(np.frombuffer(cdr.octets(), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(decoded, picture(1))
    assert cdr.at_end()


def test_a_raw_message_is_a_ros_image() -> None:
    image = picture(2)
    cdr = Cdr(format_.encode_raw(T_NS, image))
    assert (cdr.number("i"), cdr.number("I")) == divmod(T_NS, 10**9)
    assert cdr.string() == "cam"
    assert (cdr.number("I"), cdr.number("I")) == image.shape
    assert (cdr.string(), cdr.number("B"), cdr.number("I")) == ("mono8", 0, 64)
    assert cdr.octets() == image.tobytes()
    assert cdr.at_end()


@pytest.mark.parametrize("encode", [format_.encode_png, format_.encode_raw])
def test_images_come_back_to_the_last_bit(encode: object) -> None:
    message = encode(T_NS, picture(3))  # type: ignore[operator]
    data = format_.image_file_bytes(message)
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(decoded, picture(3))


@pytest.mark.parametrize("encode", [format_.encode_png, format_.encode_raw])
@pytest.mark.parametrize("length", [0, 3, 31, 35, 47, 60, -1])
def test_a_message_cut_short_is_refused(encode: object, length: int) -> None:
    message = encode(T_NS, picture(3))  # type: ignore[operator]
    with pytest.raises(RecordingError, match="no grey image"):
        format_.image_file_bytes(message[:length])


def test_a_header_comes_back_with_its_camera() -> None:
    made = header("s", 7)
    read = format_.header_from_metadata(made.to_metadata())
    assert read == made
    camera_file = read.camera_file()
    assert camera_file.camera == CAMERA
    assert (camera_file.rate_hz, camera_file.identity) == (10.0, "serial:A1")


def test_a_header_of_a_later_format_is_refused() -> None:
    with pytest.raises(RecordingError, match="of format 2"):
        format_.header_from_metadata(header().to_metadata() | {"format": "2"})
