# SPDX-License-Identifier: Apache-2.0
"""Finds what the calibration missed, while the odometry runs: bend and fall-off, rolling shutter.

A lens that is said to be straight and is not, corners darker than the centre, or rows that
are read one after another, bend the whole path. The window's residuals depend on both as on its
poses and depths; what is left after those are eliminated adds up over keyframes.
"""

from typing import NamedTuple

import numpy as np

from edge.image.pyramid import STILL, radius_2
from edge.image.shade import bilinear
from edge.odometry.kernels_window import GREY, PATTERN_SIZE, U, V
from edge.types import F32, F64, Pinhole

# What is known without any image: log of the focal length's error, bend, read-out time [s] by
# turning, and by translation, log of the fall-off of brightness. The first and fourth are only
# allowed for: one camera's motion hardly shows its focal length, and what translation does
# depends on depth.
PRIOR_SIGMA = (0.01, 0.05, 0.03, 0.03, 0.5)
# What a window errs by whatever it says: blur, shine, and what is not modelled.
WINDOW_SIGMA = (0.0, 0.002, 0.003, 0.0, 0.03)
# A smaller change is not worth it: a fifth of a pixel in the corners; the same at 1 rad/s; a
# twentieth of the brightness.
MIN_STEP = (0.0, 0.0015, 0.0015, 0.0, 0.05)
# No lens that is called straight, no camera that is in use; none makes corners brighter.
LOWEST = (0.0, -0.5, -0.04, 0.0, 0.0)
HIGHEST = (0.0, 0.5, 0.04, 0.0, 1.5)
# Time to read an image, where nothing is known of it: most cameras are no slower.
SLOWEST_S = 0.03
# Windows in a row share most of their residuals: each counts so much.
SHARE_OF_WINDOW = 1.0 / 3.0
# Windows are forgotten over so many keyframes; their weights must reach this sum.
MEMORY_KEYFRAMES, MIN_COUNT = 10.0, 4.0
# Gauss-Newton on noisy images falls short: on real video it goes a third of the way, on rendered
# scenes nearly all of it. The first change takes it for the first; later ones know.
FIRST_RESPONSE, MIN_RESPONSE = 0.67, 0.25
MIN_SIGMAS = 2.5


class LensSystem(NamedTuple):
    """Normal equations of the five unknowns alone, over a residual's variance."""

    H: F64  # (5, 5)
    b: F64  # (5,)


class LensEstimate:
    """Owned by the thread of the keyframe work."""

    def __init__(self) -> None:
        self._bend, self._readout, self._falloff = _Parameter(1), _Parameter(2), _Parameter(4)

    @property
    def radial(self) -> float:
        """Bend of the lens beside its calibration, as in CameraModel."""
        return self._bend.value

    @property
    def readout_s(self) -> float:
        """From the first row's exposure to the last one's."""
        return self._readout.value

    @property
    def most_readout_s(self) -> float:
        """What it may take to read a whole image, by what is known of it."""
        sigma = self._readout.sigma
        return SLOWEST_S if sigma is None else min(abs(self.readout_s) + 2.0 * sigma, SLOWEST_S)

    @property
    def falloff(self) -> float:
        """Log of how much darker the corners are than the centre."""
        return self._falloff.value

    def add(self, system: LensSystem) -> bool:
        """Take in what a window says; whether anything has changed."""
        if not (np.all(np.isfinite(system.H)) and np.all(np.isfinite(system.b))):
            return False
        H = system.H + np.diag(np.power(PRIOR_SIGMA, -2.0))
        size = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-12))
        values, vectors = np.linalg.eigh(H * size[:, None] * size[None, :])
        # Rounding can leave nothing of a weak window.
        if not values[0] > 1e-6:
            return False
        covariance = (vectors / values) @ vectors.T * size[:, None] * size[None, :]
        step = -covariance @ system.b
        found = self._bend, self._readout, self._falloff
        changed = [p.add(step[p.index], covariance[p.index, p.index]) for p in found]
        return any(changed)


class _Parameter:
    """A fading average of the windows' answers, acted upon where it is certain."""

    def __init__(self, index: int) -> None:
        self.index, self.value = index, 0.0
        self._response = FIRST_RESPONSE
        self._last: tuple[float, float] | None = None  # value and mean before the last change
        self._forget()

    def _forget(self) -> None:
        self._weight = self._sum = self._misfit = self._count = 0.0

    def add(self, step: float, variance: float) -> bool:
        """Take in a window's `step` from the current value; whether the value has changed."""
        variance += WINDOW_SIGMA[self.index] ** 2
        keep = 1.0 - 1.0 / MEMORY_KEYFRAMES
        before = self._sum / self._weight if self._weight > 0.0 else step
        self._misfit = keep * self._misfit + (step - before) ** 2 / variance
        self._weight = keep * self._weight + 1.0 / variance
        self._sum = keep * self._sum + step / variance
        self._count = keep * self._count + 1.0
        return self._change()

    @property
    def sigma(self) -> float | None:
        """Standard deviation of the value; None before enough windows have told."""
        if self._count < MIN_COUNT:
            return None
        # Where windows disagree by more than they say, they know less than they say.
        inflation = max(1.0, self._misfit / max(self._count - 1.0, 1.0))
        return float(np.sqrt(inflation / (SHARE_OF_WINDOW * self._weight)))

    def _change(self) -> bool:
        mean, sigma = self._sum / self._weight, self.sigma
        if sigma is None or abs(mean) < max(MIN_STEP[self.index], MIN_SIGMAS * sigma):
            return False
        if self._last is not None:
            # The secant through both averages, half believed as they are noisy.
            slope = (self._last[1] - mean) / (self.value - self._last[0])
            self._response += 0.5 * (float(np.clip(slope, MIN_RESPONSE, 1.0)) - self._response)
        value = self.value + mean / self._response
        value = float(np.clip(value, LOWEST[self.index], HIGHEST[self.index]))
        if value == self.value:
            return False
        self._last = self.value, mean
        self.value = value
        self._forget()
        return True


def moved_pixels(pixels: F32, pinhole: Pinhole, radial: float, turn: F64) -> F32:
    """Where pixels (2, n) lie once the lens bends, and the camera turns, by so much more.

    `turn` (3,) is the angle over the whole read-out [rad]. First order in both.
    """
    x, y = (pixels[0] - pinhole.cx) / pinhole.fx, (pixels[1] - pinhole.cy) / pinhole.fy
    late = pixels[1] / pinhole.height - 0.5
    spin = turn[0] * y - turn[1] * x
    bend = radial * (x * x + y * y)
    u = pixels[0] - pinhole.fx * (x * bend + late * (turn[2] * y - turn[1] + x * spin))
    v = pixels[1] - pinhole.fy * (y * bend + late * (turn[0] - turn[2] * x + y * spin))
    return np.stack((u, v)).astype(np.float32)


def as_found(pixels: F32, pinhole: Pinhole, radial: float) -> F32:
    """Where ideal pixels (2, n) of the calibration lie in images freed of the bend found since."""
    return moved_pixels(pixels, pinhole, radial, STILL)


def as_calibrated(pixels: F32, pinhole: Pinhole, radial: float) -> F32:
    """Back again: all others know the calibration only."""
    return moved_pixels(pixels, pinhole, -radial, STILL)


def brightened(
    table: F32, pinhole: Pinhole, falloff: float, gains: tuple[F32 | None, F32 | None]
) -> F32:
    """Points or candidates as an image shows them that is corrected for so much more fall-off.

    gains  (h, w) each, against soft shades: that of the image until now, and that from now on
    """
    at = np.clip(table[U], 0, pinhole.width - 1), np.clip(table[V], 0, pinhole.height - 1)
    before, after = (np.ones(1) if gain is None else bilinear(gain, *at) for gain in gains)
    out = table.copy()
    brighter = np.exp(falloff * radius_2(pinhole, *at)) * after / before
    out[GREY : GREY + PATTERN_SIZE] *= brighter.astype(np.float32)
    return out
