# SPDX-License-Identifier: Apache-2.0
"""Exposure and gain of a video device: set, read back, said."""

import ctypes
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from edge.cameras import v4l2_abi as abi
from edge.cameras.v4l2_stream import VideoStream
from edge.config.v4l2 import V4l2Config
from edge.errors import CameraRefused

log = logging.getLogger(__name__)

_EXPOSURE_UNIT_NS = 100_000


@dataclass(frozen=True, slots=True)
class Range:
    """What a control takes."""

    minimum: int
    maximum: int
    step: int


class Taken(NamedTuple):
    """How images are taken, as far as it is known."""

    exposure_ns: int | None
    gain_db: float | None


def set_exposure_and_gain(stream: VideoStream, config: V4l2Config) -> int | None:
    """Set both as configured; returns the exposure [ns] that the camera has now, if it is fixed.

    CameraRefused says which values the camera takes.
    """
    # It would let the rate sink in the dark, behind the fixed exposure's back.
    if find_range(stream, abi.CID_EXPOSURE_AUTO_PRIORITY):
        _write(stream, abi.CID_EXPOSURE_AUTO_PRIORITY, 0)
    if config.gain is not None:
        _set_gain(stream, config.gain)
    if config.exposure_us is not None:
        return _set_exposure(stream, config.exposure_us)
    modes = (abi.EXPOSURE_APERTURE_PRIORITY, abi.EXPOSURE_AUTO)
    if find_range(stream, abi.CID_EXPOSURE_AUTO) and not any(
        _write(stream, abi.CID_EXPOSURE_AUTO, mode) for mode in modes
    ):
        log.warning("event=exposure_mode_unset device=%s: it stays as it is", stream.path)
    return None


def find_range(stream: VideoStream, control: int) -> Range | None:
    """What the control takes; None where the device lacks it or lets nobody set it."""
    query = abi.QueryCtrl(id=control)
    if not stream.try_request(abi.QUERYCTRL, query):
        return None
    if query.flags & (abi.CTRL_FLAG_DISABLED | abi.CTRL_FLAG_READ_ONLY):
        return None
    return Range(query.minimum, query.maximum, max(query.step, 1))


def follow_automatic(stream: VideoStream, config: V4l2Config) -> Callable[[], Taken]:
    """What tells how images are exposed now, where the camera decides that itself.

    Each answer is a request to the device. What does not change by itself as far as the driver
    knows is not asked for: its number would be the last one that somebody set.
    """
    controls = []
    if config.exposure_us is None:
        controls.append(abi.CID_EXPOSURE_ABSOLUTE)
    if config.gain is None and config.gain_db_per_step is not None:
        controls += [abi.CID_GAIN, abi.CID_ANALOGUE_GAIN]
    changing = [control for control in controls if _is_volatile(stream, control)]
    step_db = config.gain_db_per_step or 0.0

    def read() -> Taken:
        values = {control: _read(stream, control) for control in changing}
        exposure = values.get(abi.CID_EXPOSURE_ABSOLUTE)
        gain = values.get(abi.CID_GAIN, values.get(abi.CID_ANALOGUE_GAIN))
        return Taken(
            None if exposure is None else exposure * _EXPOSURE_UNIT_NS,
            None if gain is None else gain * step_db,
        )

    return read if changing else lambda: Taken(None, None)


def _is_volatile(stream: VideoStream, control: int) -> bool:
    query = abi.QueryCtrl(id=control)
    return stream.try_request(abi.QUERYCTRL, query) and bool(query.flags & abi.CTRL_FLAG_VOLATILE)


def _set_exposure(stream: VideoStream, exposure_us: float) -> int:
    """Automatic off first: while it is on, drivers refuse or overwrite the value."""
    has_mode = find_range(stream, abi.CID_EXPOSURE_AUTO) is not None
    if has_mode and not _write(stream, abi.CID_EXPOSURE_AUTO, abi.EXPOSURE_MANUAL):
        raise CameraRefused(
            f"{stream.path}: its automatic exposure cannot be switched off: leave exposure_us out"
        )
    takes = find_range(stream, abi.CID_EXPOSURE_ABSOLUTE)
    if takes is None:
        raise CameraRefused(
            f"{stream.path}: its exposure cannot be set in microseconds: leave exposure_us out"
        )
    wanted = round(exposure_us * 1000 / _EXPOSURE_UNIT_NS)
    unit_us = _EXPOSURE_UNIT_NS // 1000
    if not takes.minimum <= wanted <= takes.maximum:
        raise CameraRefused(
            f"{stream.path}: takes an exposure_us from {takes.minimum * unit_us} to "
            f"{takes.maximum * unit_us}, not {exposure_us:g}"
        )
    got = _set(stream, "exposure", abi.CID_EXPOSURE_ABSOLUTE, wanted, takes)
    if has_mode and _read(stream, abi.CID_EXPOSURE_AUTO) != abi.EXPOSURE_MANUAL:
        raise CameraRefused(
            f"{stream.path}: its automatic exposure came on again: leave exposure_us out"
        )
    return got * _EXPOSURE_UNIT_NS


def _set_gain(stream: VideoStream, gain: int) -> None:
    if find_range(stream, abi.CID_AUTOGAIN):
        _write(stream, abi.CID_AUTOGAIN, 0)
    for control in (abi.CID_GAIN, abi.CID_ANALOGUE_GAIN):
        if takes := find_range(stream, control):
            if not takes.minimum <= gain <= takes.maximum:
                raise CameraRefused(
                    f"{stream.path}: takes a gain from {takes.minimum} to {takes.maximum}, "
                    f"not {gain}"
                )
            _set(stream, "gain", control, gain, takes)
            return
    raise CameraRefused(f"{stream.path}: its gain cannot be set: leave gain out")


def _set(stream: VideoStream, name: str, control: int, wanted: int, takes: Range) -> int:
    """Write, read back and say a value; what the camera has now counts."""
    if not _write(stream, control, wanted):
        raise CameraRefused(f"{stream.path}: refuses {name} {wanted}: set another or leave it out")
    got = _read(stream, control)
    if got is None:
        got = wanted
    if abs(got - wanted) > takes.step:
        raise CameraRefused(
            f"{stream.path}: made {name} {got} of {wanted}: set a value that it keeps"
        )
    log.info("event=camera_control device=%s %s=%d wanted=%d", stream.path, name, got, wanted)
    return got


def _write(stream: VideoStream, control: int, value: int) -> bool:
    item, request = _one(control)
    item.u.value = value
    return stream.try_request(abi.S_EXT_CTRLS, request)


def _read(stream: VideoStream, control: int) -> int | None:
    item, request = _one(control)
    if not stream.try_request(abi.G_EXT_CTRLS, request):
        return None
    return int(item.u.value)


def _one(control: int) -> tuple[abi.ExtControl, abi.ExtControls]:
    """A control, and the request that points to it."""
    item = abi.ExtControl(id=control)
    # By class, which old kernels ask for and new ones allow.
    request = abi.ExtControls(which=control & 0x0FFF0000, count=1, controls=ctypes.pointer(item))
    return item, request
