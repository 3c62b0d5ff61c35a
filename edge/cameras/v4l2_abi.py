# SPDX-License-Identifier: Apache-2.0
"""The part of the kernel's video interface (linux/videodev2.h) that a camera needs.

Structures are those of 64-bit systems, which x86-64 and aarch64 share; request
numbers follow from their sizes.
"""

import ctypes
from typing import Any

_u8, _u32, _s32, _s64 = ctypes.c_uint8, ctypes.c_uint32, ctypes.c_int32, ctypes.c_int64

BUF_TYPE_VIDEO_CAPTURE = 1
MEMORY_MMAP = 1
FIELD_NONE = 1

CAP_VIDEO_CAPTURE = 0x00000001
CAP_STREAMING = 0x04000000
CAP_DEVICE_CAPS = 0x80000000
CAP_TIMEPERFRAME = 0x1000

BUF_FLAG_ERROR = 0x00000040
BUF_FLAG_TIMESTAMP_MASK = 0x0000E000
BUF_FLAG_TIMESTAMP_MONOTONIC = 0x00002000
BUF_FLAG_TSTAMP_SRC_MASK = 0x00070000
BUF_FLAG_TSTAMP_SRC_EOF = 0x00000000
BUF_FLAG_TSTAMP_SRC_SOE = 0x00010000

CTRL_FLAG_DISABLED = 0x0001
CTRL_FLAG_READ_ONLY = 0x0004
CTRL_FLAG_VOLATILE = 0x0080

_USER_BASE = 0x00980900
_CAMERA_BASE = 0x009A0900
_IMAGE_SOURCE_BASE = 0x009E0900
CID_AUTOGAIN = _USER_BASE + 18
CID_GAIN = _USER_BASE + 19
CID_EXPOSURE_AUTO = _CAMERA_BASE + 1
CID_EXPOSURE_ABSOLUTE = _CAMERA_BASE + 2  # in units of 100 us
CID_EXPOSURE_AUTO_PRIORITY = _CAMERA_BASE + 3  # may the rate sink for a longer exposure
CID_ANALOGUE_GAIN = _IMAGE_SOURCE_BASE + 3

EXPOSURE_AUTO, EXPOSURE_MANUAL, EXPOSURE_APERTURE_PRIORITY = 0, 1, 3


def fourcc(name: str) -> int:
    """The number of a pixel format of four letters."""
    return int.from_bytes(name.encode("ascii"), "little")


def fourcc_name(number: int) -> str:
    """The four letters of a pixel format."""
    return number.to_bytes(4, "little").decode("ascii", "replace")


class Capability(ctypes.Structure):
    """`struct v4l2_capability`."""

    _fields_ = (
        ("driver", _u8 * 16),
        ("card", _u8 * 32),
        ("bus_info", _u8 * 32),
        ("version", _u32),
        ("capabilities", _u32),
        ("device_caps", _u32),
        ("reserved", _u32 * 3),
    )


class FmtDesc(ctypes.Structure):
    """`struct v4l2_fmtdesc`."""

    _fields_ = (
        ("index", _u32),
        ("type", _u32),
        ("flags", _u32),
        ("description", _u8 * 32),
        ("pixelformat", _u32),
        ("mbus_code", _u32),
        ("reserved", _u32 * 3),
    )


class PixFormat(ctypes.Structure):
    """`struct v4l2_pix_format`."""

    _fields_ = (
        ("width", _u32),
        ("height", _u32),
        ("pixelformat", _u32),
        ("field", _u32),
        ("bytesperline", _u32),
        ("sizeimage", _u32),
        ("colorspace", _u32),
        ("priv", _u32),
        ("flags", _u32),
        ("ycbcr_enc", _u32),
        ("quantization", _u32),
        ("xfer_func", _u32),
    )


class _FormatUnion(ctypes.Union):
    # Another member holds pointers, so the union is aligned to 8 bytes.
    _fields_ = (("pix", PixFormat), ("raw_data", _u8 * 200), ("_align", ctypes.c_uint64))


class Format(ctypes.Structure):
    """`struct v4l2_format`."""

    _fields_ = (("type", _u32), ("fmt", _FormatUnion))


class Fract(ctypes.Structure):
    """`struct v4l2_fract`."""

    _fields_ = (("numerator", _u32), ("denominator", _u32))


class CaptureParm(ctypes.Structure):
    """`struct v4l2_captureparm`."""

    _fields_ = (
        ("capability", _u32),
        ("capturemode", _u32),
        ("timeperframe", Fract),
        ("extendedmode", _u32),
        ("readbuffers", _u32),
        ("reserved", _u32 * 4),
    )


class _ParmUnion(ctypes.Union):
    _fields_ = (("capture", CaptureParm), ("raw_data", _u8 * 200))


class StreamParm(ctypes.Structure):
    """`struct v4l2_streamparm`."""

    _fields_ = (("type", _u32), ("parm", _ParmUnion))


class RequestBuffers(ctypes.Structure):
    """`struct v4l2_requestbuffers`."""

    _fields_ = (
        ("count", _u32),
        ("type", _u32),
        ("memory", _u32),
        ("capabilities", _u32),
        ("flags", _u8),
        ("reserved", _u8 * 3),
    )


class TimeVal(ctypes.Structure):
    """`struct timeval`."""

    _fields_ = (("tv_sec", _s64), ("tv_usec", _s64))


class TimeCode(ctypes.Structure):
    """`struct v4l2_timecode`."""

    _fields_ = (
        ("type", _u32),
        ("flags", _u32),
        ("frames", _u8),
        ("seconds", _u8),
        ("minutes", _u8),
        ("hours", _u8),
        ("userbits", _u8 * 4),
    )


class _Place(ctypes.Union):
    _fields_ = (("offset", _u32), ("userptr", ctypes.c_uint64), ("fd", _s32))


class Buffer(ctypes.Structure):
    """`struct v4l2_buffer`."""

    _fields_ = (
        ("index", _u32),
        ("type", _u32),
        ("bytesused", _u32),
        ("flags", _u32),
        ("field", _u32),
        ("timestamp", TimeVal),
        ("timecode", TimeCode),
        ("sequence", _u32),
        ("memory", _u32),
        ("m", _Place),
        ("length", _u32),
        ("reserved2", _u32),
        ("request_fd", _s32),
    )


class QueryCtrl(ctypes.Structure):
    """`struct v4l2_queryctrl`."""

    _fields_ = (
        ("id", _u32),
        ("type", _u32),
        ("name", _u8 * 32),
        ("minimum", _s32),
        ("maximum", _s32),
        ("step", _s32),
        ("default_value", _s32),
        ("flags", _u32),
        ("reserved", _u32 * 2),
    )


class _Value(ctypes.Union):
    _pack_ = 1
    _fields_ = (("value", _s32), ("value64", _s64), ("ptr", ctypes.c_void_p))


class ExtControl(ctypes.Structure):
    """`struct v4l2_ext_control`, which is packed."""

    _pack_ = 1
    _fields_ = (("id", _u32), ("size", _u32), ("reserved2", _u32 * 1), ("u", _Value))


class ExtControls(ctypes.Structure):
    """`struct v4l2_ext_controls`."""

    _fields_ = (
        ("which", _u32),
        ("count", _u32),
        ("error_idx", _u32),
        ("request_fd", _s32),
        ("reserved", _u32 * 1),
        ("controls", ctypes.POINTER(ExtControl)),
    )


_WRITE, _READ = 1, 2


def _request(direction: int, number: int, kind: Any) -> int:
    """The kernel's _IOC: direction, size, the letter V, number."""
    return direction << 30 | ctypes.sizeof(kind) << 16 | ord("V") << 8 | number


QUERYCAP = _request(_READ, 0, Capability)
ENUM_FMT = _request(_READ | _WRITE, 2, FmtDesc)
S_FMT = _request(_READ | _WRITE, 5, Format)
REQBUFS = _request(_READ | _WRITE, 8, RequestBuffers)
QUERYBUF = _request(_READ | _WRITE, 9, Buffer)
QBUF = _request(_READ | _WRITE, 15, Buffer)
DQBUF = _request(_READ | _WRITE, 17, Buffer)
STREAMON = _request(_WRITE, 18, ctypes.c_int)
STREAMOFF = _request(_WRITE, 19, ctypes.c_int)
S_PARM = _request(_READ | _WRITE, 22, StreamParm)
QUERYCTRL = _request(_READ | _WRITE, 36, QueryCtrl)
G_EXT_CTRLS = _request(_READ | _WRITE, 71, ExtControls)
S_EXT_CTRLS = _request(_READ | _WRITE, 72, ExtControls)
