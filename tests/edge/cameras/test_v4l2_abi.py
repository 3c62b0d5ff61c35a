# SPDX-License-Identifier: Apache-2.0
"""Layouts against the numbers of the kernel's interface, and against its header where it is."""

import ctypes
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from edge.cameras import v4l2_abi as abi

# Request numbers of 64-bit Linux, as strace and the kernel's compatibility tests list them.
REQUESTS = {
    "QUERYCAP": 0x80685600,
    "ENUM_FMT": 0xC0405602,
    "S_FMT": 0xC0D05605,
    "REQBUFS": 0xC0145608,
    "QUERYBUF": 0xC0585609,
    "QBUF": 0xC058560F,
    "DQBUF": 0xC0585611,
    "STREAMON": 0x40045612,
    "STREAMOFF": 0x40045613,
    "S_PARM": 0xC0CC5616,
    "QUERYCTRL": 0xC0445624,
    "G_EXT_CTRLS": 0xC0205647,
    "S_EXT_CTRLS": 0xC0205648,
}
STRUCTURES: dict[str, Any] = {
    "capability": abi.Capability,
    "fmtdesc": abi.FmtDesc,
    "pix_format": abi.PixFormat,
    "format": abi.Format,
    "fract": abi.Fract,
    "captureparm": abi.CaptureParm,
    "streamparm": abi.StreamParm,
    "requestbuffers": abi.RequestBuffers,
    "timecode": abi.TimeCode,
    "buffer": abi.Buffer,
    "queryctrl": abi.QueryCtrl,
    "ext_control": abi.ExtControl,
    "ext_controls": abi.ExtControls,
}
CONSTANTS = {
    "V4L2_BUF_TYPE_VIDEO_CAPTURE": abi.BUF_TYPE_VIDEO_CAPTURE,
    "V4L2_MEMORY_MMAP": abi.MEMORY_MMAP,
    "V4L2_FIELD_NONE": abi.FIELD_NONE,
    "V4L2_CAP_VIDEO_CAPTURE": abi.CAP_VIDEO_CAPTURE,
    "V4L2_CAP_STREAMING": abi.CAP_STREAMING,
    "V4L2_CAP_DEVICE_CAPS": abi.CAP_DEVICE_CAPS,
    "V4L2_CAP_TIMEPERFRAME": abi.CAP_TIMEPERFRAME,
    "V4L2_BUF_FLAG_ERROR": abi.BUF_FLAG_ERROR,
    "V4L2_BUF_FLAG_TIMESTAMP_MASK": abi.BUF_FLAG_TIMESTAMP_MASK,
    "V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC": abi.BUF_FLAG_TIMESTAMP_MONOTONIC,
    "V4L2_BUF_FLAG_TSTAMP_SRC_MASK": abi.BUF_FLAG_TSTAMP_SRC_MASK,
    "V4L2_BUF_FLAG_TSTAMP_SRC_EOF": abi.BUF_FLAG_TSTAMP_SRC_EOF,
    "V4L2_BUF_FLAG_TSTAMP_SRC_SOE": abi.BUF_FLAG_TSTAMP_SRC_SOE,
    "V4L2_CTRL_FLAG_DISABLED": abi.CTRL_FLAG_DISABLED,
    "V4L2_CTRL_FLAG_READ_ONLY": abi.CTRL_FLAG_READ_ONLY,
    "V4L2_CID_AUTOGAIN": abi.CID_AUTOGAIN,
    "V4L2_CID_GAIN": abi.CID_GAIN,
    "V4L2_CID_EXPOSURE_AUTO": abi.CID_EXPOSURE_AUTO,
    "V4L2_CID_EXPOSURE_ABSOLUTE": abi.CID_EXPOSURE_ABSOLUTE,
    "V4L2_CID_EXPOSURE_AUTO_PRIORITY": abi.CID_EXPOSURE_AUTO_PRIORITY,
    "V4L2_CID_ANALOGUE_GAIN": abi.CID_ANALOGUE_GAIN,
    "V4L2_EXPOSURE_AUTO": abi.EXPOSURE_AUTO,
    "V4L2_EXPOSURE_MANUAL": abi.EXPOSURE_MANUAL,
    "V4L2_EXPOSURE_APERTURE_PRIORITY": abi.EXPOSURE_APERTURE_PRIORITY,
    "V4L2_PIX_FMT_GREY": abi.fourcc("GREY"),
    "V4L2_PIX_FMT_YUYV": abi.fourcc("YUYV"),
    "V4L2_PIX_FMT_MJPEG": abi.fourcc("MJPG"),
}
# Members that C names otherwise: unions without a name, and what has none there.
_C_NAMES = {"u": "value", "request_fd": "request_fd"}
HEADER = Path("/usr/include/linux/videodev2.h")


@pytest.mark.parametrize("name", REQUESTS)
def test_request_numbers_are_the_kernels(name: str) -> None:
    assert getattr(abi, name) == REQUESTS[name]


def test_pixel_formats_keep_their_names() -> None:
    assert abi.fourcc_name(abi.fourcc("YUYV")) == "YUYV"


@pytest.mark.skipif(
    shutil.which("gcc") is None or not HEADER.exists(), reason="no C compiler or kernel header"
)
def test_layouts_and_numbers_are_those_of_the_header(tmp_path: Path) -> None:
    expected: dict[str, int] = {f"VIDIOC_{name}": getattr(abi, name) for name in REQUESTS}
    expected |= CONSTANTS
    for name, kind in STRUCTURES.items():
        expected[f"sizeof(struct v4l2_{name})"] = ctypes.sizeof(kind)
        for field, *_ in kind._fields_:
            place = f"offsetof(struct v4l2_{name}, {_C_NAMES.get(field, field)})"
            expected[place] = getattr(kind, field).offset
    lines = [f'printf("%lu\\n", (unsigned long)({item}));' for item in expected]
    source = tmp_path / "layout.c"
    source.write_text(
        "#include <stdio.h>\n#include <stddef.h>\n#include <linux/videodev2.h>\n"
        f"int main(void) {{ {' '.join(lines)} return 0; }}\n"
    )
    program = tmp_path / "layout"
    subprocess.run(["gcc", "-o", program, source], check=True)
    printed = subprocess.run([program], capture_output=True, check=True, text=True).stdout
    found = dict(zip(expected, map(int, printed.split()), strict=True))
    assert found == expected
