# SPDX-License-Identifier: Apache-2.0
"""What stands in a recording file: topics, image messages and the header; pure functions of bytes.

Images are ROS 2 messages in CDR, so that any viewer of MCAP files shows them.
"""

import struct
import tomllib
from dataclasses import dataclass, field

import cv2
import numpy as np

from edge.errors import ConfigError, RecordingError
from edge.geometry.camera import CameraFile, parse_camera
from edge.types import U8

IMAGE, FRAME = "/camera/image", "/camera/frame"
POSE, ODOMETRY, FIX, STATE = "/pose", "/odometry", "/fix", "/state"

HEADER_NAME = "mapvo"
FORMAT_VERSION = 1

# Little-endian CDR; both messages begin alike: stamp, then frame_id "cam".
_CDR_LE = b"\x00\x01\x00\x00"
_FRAME_ID = b"cam\0"
_COMPRESSED = struct.Struct("<4siII4sI4sI")
_RAW = struct.Struct("<4siII4sIII6sBxII")
_MONO8 = b"mono8\0"
_PNG_SIGNATURE = b"\x89PNG"

_STAMP_DEFINITION = """std_msgs/Header header
{fields}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
COMPRESSED_SCHEMA = (
    "sensor_msgs/msg/CompressedImage",
    _STAMP_DEFINITION.format(fields="string format\nuint8[] data"),
)
RAW_SCHEMA = (
    "sensor_msgs/msg/Image",
    _STAMP_DEFINITION.format(
        fields="uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
        "uint8[] data"
    ),
)


@dataclass(frozen=True, slots=True)
class Header:
    """What holds for a whole file."""

    camera_toml: str  # camera, rate and identity; empty: not calibrated yet
    session: str  # the same in all files of one run
    segment: int = 0  # place of the file in its session
    info: dict[str, str] = field(default_factory=dict)  # versions, settings, start: for people

    def to_metadata(self) -> dict[str, str]:
        """As a metadata record holds it."""
        return {
            **self.info,
            "format": str(FORMAT_VERSION),
            "camera": self.camera_toml,
            "session": self.session,
            "segment": str(self.segment),
        }

    def camera_file(self) -> CameraFile:
        """The camera; RecordingError where the text is none."""
        if not self.camera_toml:
            raise RecordingError("was recorded without a calibration: `mapvo calibrate` takes it")
        try:
            return parse_camera(tomllib.loads(self.camera_toml))
        except (ConfigError, tomllib.TOMLDecodeError, RecursionError) as error:
            raise RecordingError(f"its camera cannot be read: {error}") from error


def header_from_metadata(metadata: dict[str, str]) -> Header:
    """Header of a metadata record; RecordingError where it is of another version or damaged."""
    version = metadata.get("format", "")
    if version != str(FORMAT_VERSION):
        raise RecordingError(
            f"is of format {version or '(none)'}, this version reads {FORMAT_VERSION}: update mapvo"
        )
    segment = metadata.get("segment", "0")
    fixed = {"format", "camera", "session", "segment"}
    return Header(
        metadata.get("camera", ""),
        metadata.get("session", ""),
        int(segment) if segment.isascii() and segment.isdigit() else 0,
        {key: value for key, value in metadata.items() if key not in fixed},
    )


def encode_png(t_ns: int, image: U8) -> bytes:
    """CompressedImage message of a grey image (h, w) uint8, without loss."""
    # Huffman coding alone takes half the time and is smaller on camera noise than matching.
    strategy = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)
    options = (cv2.IMWRITE_PNG_COMPRESSION, 1, *strategy)
    data = cv2.imencode(".png", image, options)[1].tobytes()
    head = _COMPRESSED.pack(*_stamp(t_ns), len(_FRAME_ID), _FRAME_ID, 4, b"png\0", len(data))
    return head + data


def encode_raw(t_ns: int, image: U8) -> bytes:
    """Image message (mono8) of a grey image (h, w) uint8."""
    height, width = image.shape
    head = _RAW.pack(
        *(*_stamp(t_ns), len(_FRAME_ID), _FRAME_ID, height, width),
        *(len(_MONO8), _MONO8, 0, width, image.size),
    )
    return head + np.ascontiguousarray(image).tobytes()


def image_file_bytes(message: bytes) -> bytes:
    """The image as the bytes of a PNG or PGM file; RecordingError where the message holds none."""
    if message[_COMPRESSED.size :].startswith(_PNG_SIGNATURE):
        size = _COMPRESSED.unpack_from(message)[-1]
        if size == len(message) - _COMPRESSED.size:
            return message[_COMPRESSED.size :]
    if len(message) > _RAW.size:
        *_, height, width, _, encoding, _, step, size = _RAW.unpack_from(message)
        is_whole = size == height * width == len(message) - _RAW.size
        if encoding == _MONO8 and step == width and is_whole:
            return b"P5\n%d %d\n255\n" % (width, height) + message[_RAW.size :]
    raise RecordingError("is no grey image that mapvo recorded")


def _stamp(t_ns: int) -> tuple[bytes, int, int]:
    """Beginning of a message; the exact time is the record's own, this one is for viewers."""
    seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
    return _CDR_LE, seconds % 2**31, nanoseconds
