# SPDX-License-Identifier: Apache-2.0
"""The doctor looks through the camera for a moment: rate, age of the images, light, sharpness."""

import threading
import time
from collections.abc import Callable
from contextlib import closing
from typing import NamedTuple

import numpy as np

from edge.cameras.live import open_live, open_uncalibrated
from edge.config.camera import CameraConfig
from edge.errors import EdgeError
from edge.runtime.doctor_host import Finding, bad, doubtful, good
from edge.runtime.record import Source
from edge.types import U8, Frame

_SECONDS = 3.0
_SETTLE_FRAMES = 5  # automatic exposure finds its place
_RATE_TOLERANCE = 0.05
_OLD_MS = 100.0
_DARK_GREY, _SATURATED_GREY, _SATURATED_SHARE = 25.0, 250, 0.2
_EDGE_GREY, _LEAST_EDGES = 15.0, 0.005  # a step between neighbours, and the share of such


class Glance(NamedTuple):
    """A frame, and how old it was when it came."""

    frame: Frame
    age_ms: float


def look(config: CameraConfig, seconds: float = _SECONDS) -> list[Finding]:
    """What a live camera shows; where another program has it, that is said."""
    if config.source == "recording":
        return []
    is_known = bool(config.calibration) or config.source == "oak"
    try:
        source = (open_live if is_known else open_uncalibrated)(config)
        return look_through(source, source.rate_hz, seconds)
    except EdgeError as error:
        return [bad("look", str(error), "end `mapvo run` if it has the camera: one at a time")]


def look_through(
    source: Source,
    rate_hz: float,
    seconds: float,
    now_ns: Callable[[], int] = time.monotonic_ns,
) -> list[Finding]:
    """What a source shows within the time; it is closed afterwards."""
    timer = threading.Timer(seconds, source.stop)
    timer.start()
    glances: list[Glance] = []
    with closing(source):
        try:
            glances.extend(Glance(frame, (now_ns() - frame.t_ns) * 1e-6) for frame in source)
        finally:
            timer.cancel()
            timer.join()
    if len(glances) <= _SETTLE_FRAMES:
        found = f"{len(glances)} images in {seconds:g} s"
        return [bad("look", found, "check cable and power; see `mapvo -v doctor --look`")]
    settled = glances[_SETTLE_FRAMES:]
    return [
        _rate(settled, rate_hz, source.dropped),
        _age(settled),
        *_picture(settled[-1].frame.image),
    ]


def _rate(glances: list[Glance], rate_hz: float, dropped: int) -> Finding:
    intervals = np.diff([glance.frame.t_ns for glance in glances])
    measured_hz = 1e9 / float(np.median(intervals)) if len(intervals) else 0.0
    found = f"{measured_hz:.1f} Hz of {rate_hz:g}, {dropped} lost"
    if abs(measured_hz / rate_hz - 1.0) > _RATE_TOLERANCE:
        return doubtful("rate", found, "shorten the exposure, or set the rate that it has")
    if dropped > len(glances) * _RATE_TOLERANCE:
        return doubtful("rate", found, "use a bus of its own, a better cable, a smaller size")
    return good("rate", found)


def _age(glances: list[Glance]) -> Finding:
    age_ms = float(np.median([glance.age_ms for glance in glances]))
    found = f"images are {age_ms:.0f} ms old when they come"
    if age_ms < 0.0:
        remedy = "its stamps are of the future: set stamp_delay_us, or the driver's clock"
        return bad("age", found, remedy)
    if age_ms > _OLD_MS:
        return doubtful("age", found, "take GREY or YUYV instead of MJPG, fewer buffers")
    return good("age", found)


def _picture(image: U8) -> list[Finding]:
    mean = float(image.mean())
    saturated = float((image >= _SATURATED_GREY).mean())
    findings = []
    if mean < _DARK_GREY:
        remedy = "more light, a longer exposure, more gain; is the lens covered?"
        findings.append(doubtful("light", f"mean grey {mean:.0f}", remedy))
    elif saturated > _SATURATED_SHARE:
        remedy = "a shorter exposure, less gain"
        findings.append(doubtful("light", f"{saturated:.0%} of the image is white", remedy))
    else:
        findings.append(good("light", f"mean grey {mean:.0f}"))
    steps = np.abs(np.diff(image.astype(np.int16), axis=1))
    edges = float((steps > _EDGE_GREY).mean())
    if edges < _LEAST_EDGES:
        remedy = "focus it, clean it, point it at something with texture"
        findings.append(doubtful("sharpness", f"{edges:.2%} of the image are edges", remedy))
    else:
        findings.append(good("sharpness", f"{edges:.1%} of the image are edges"))
    return findings
