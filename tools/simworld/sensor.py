# SPDX-License-Identifier: Apache-2.0
"""What a real camera does to an exact image."""

import math
from dataclasses import dataclass

import numpy as np

from edge.types import F32, F64, I32, U8
from tools.simworld.errors import WorldError
from tools.simworld.packing import GAMMA
from tools.simworld.paths import Path
from tools.simworld.renderer import Rendered, Renderer

EXPOSURES = ("fixed", "sine", "steps")


@dataclass(frozen=True, slots=True)
class Sensor:
    """Imperfections; the default has none."""

    exposure: str = "fixed"  # one of EXPOSURES: how the gain changes over time
    exposure_stops: float = 0.5  # how far it goes up and down
    exposure_period_s: float = 4.0  # of the sine; steps come about as often
    vignette: float = 0.0  # share of light that is lost in the corners
    noise_grey: float = 0.0  # deviation of each channel at mid grey
    blur_ms: float = 0.0  # exposure time
    blur_samples: int = 6  # sub-exposures that make up a blurred image
    rolling_ms: float = 0.0  # read-out time from the first to the last row
    seed: int = 0

    def __post_init__(self) -> None:
        if self.exposure not in EXPOSURES:
            raise WorldError(
                f"exposure {self.exposure!r} is unknown; take one of {', '.join(EXPOSURES)}"
            )
        if not 0.0 <= self.vignette < 1.0:
            raise WorldError(f"vignette {self.vignette} is no share; take 0 to below 1")
        if min(self.noise_grey, self.blur_ms, self.rolling_ms) < 0.0 or self.blur_samples < 1:
            raise WorldError("noise, blur and rolling shutter cannot be negative")


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """One frame of a recording."""

    bgr: U8  # (h, w, 3)
    depth_m: F64  # (h, w) at mid-exposure of each row
    ids: I32  # (h, w)


def capture(renderer: Renderer, path: Path, index: int, sensor: Sensor) -> Capture:
    """Frame `index` of a path; its stamp is mid-exposure of the middle row."""
    t_s = float(path.t_ns[index]) * 1e-9
    middle, colour = _expose(renderer, path, t_s, sensor)
    colour = colour * np.float32(gain(sensor, t_s) ** (1.0 / GAMMA))
    if sensor.vignette > 0.0:
        colour *= _vignette(sensor.vignette, colour.shape[:2])
    if sensor.noise_grey > 0.0:
        rng = np.random.default_rng([sensor.seed, index, 31])
        # read noise, and shot noise that grows with the root of the signal
        sigma = sensor.noise_grey * np.sqrt(0.5 + 0.5 * np.clip(colour, 0.0, 255.0) / 128.0)
        colour = colour + sigma * rng.standard_normal(colour.shape, dtype=np.float32)
    bgr = np.clip(np.rint(colour), 0.0, 255.0).astype(np.uint8)
    return Capture(bgr, middle.depth_m, middle.ids)


def _expose(renderer: Renderer, path: Path, t_s: float, sensor: Sensor) -> tuple[Rendered, F32]:
    """The view at mid-exposure, and colours averaged over the exposure."""
    middle = renderer.render(_poses(renderer, path, t_s, sensor))
    if sensor.blur_ms == 0.0 or sensor.blur_samples == 1:
        return middle, middle.colour
    n = sensor.blur_samples
    total = np.zeros_like(middle.colour)
    for i in range(n):
        offset_s = 1e-3 * sensor.blur_ms * ((i + 0.5) / n - 0.5)
        part = renderer.render(_poses(renderer, path, t_s + offset_s, sensor))
        total += np.power(part.colour, np.float32(GAMMA))  # light adds up, grey values do not
    return middle, np.power(total / np.float32(n), np.float32(1.0 / GAMMA))


def _poses(renderer: Renderer, path: Path, t_s: float, sensor: Sensor) -> F64:
    """One pose (1, 4, 4) for all rows, or one for each (h, 4, 4)."""
    if sensor.rolling_ms == 0.0:
        return path.at(np.array([t_s]))
    h = renderer.camera.height
    rows = (np.arange(h) - 0.5 * (h - 1)) / max(h - 1, 1)
    return path.at(t_s + 1e-3 * sensor.rolling_ms * rows)


def gain(sensor: Sensor, t_s: float) -> float:
    """Linear gain of the exposure at a time; a function of time and seed alone."""
    if sensor.exposure == "fixed":
        return 1.0
    if sensor.exposure == "sine":
        wave = math.sin(2.0 * math.pi * (t_s / sensor.exposure_period_s + 0.1 * sensor.seed))
        return float(2.0 ** (sensor.exposure_stops * wave))
    # an automatic exposure moves in steps and takes a few frames for each
    step = t_s / sensor.exposure_period_s
    levels = np.random.default_rng([sensor.seed, 17]).uniform(-1.0, 1.0, math.ceil(step) + 2)
    ramp = min(1.0, (step % 1.0) * sensor.exposure_period_s / 0.15)
    k = math.floor(step)
    level = levels[k] + ramp * (levels[k + 1] - levels[k])
    return float(2.0 ** (sensor.exposure_stops * level))


def _vignette(strength: float, size: tuple[int, int]) -> F32:
    """Factor (h, w, 1) on gamma-coded values; `strength` of the light is lost in the corners."""
    h, w = size
    y, x = np.mgrid[0:h, 0:w]
    square = ((x - 0.5 * (w - 1)) ** 2 + (y - 0.5 * (h - 1)) ** 2) / (0.25 * (w**2 + h**2))
    factor = (1.0 - strength * square) ** (1.0 / GAMMA)
    return np.asarray(factor[:, :, None], np.float32)
