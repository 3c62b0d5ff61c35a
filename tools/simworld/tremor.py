# SPDX-License-Identifier: Apache-2.0
"""What a hand adds to a smooth motion."""

import math

import numpy as np

from edge.types import F64

LOW_HZ, HIGH_HZ = 0.6, 12.0
KNEE_HZ = 8.0  # rates fall beyond it; amplitudes fall everywhere, as rate over frequency
WAVES = 40
# deviations per axis of a real handheld recording's rates between LOW_HZ and HIGH_HZ,
# less what its reconstruction adds
SPEED_M_S = 0.03
TURN_RAD_S = math.radians(3.5)


class Tremor:
    """A sum of sines, exact at any time; shift [m] and turn [rad] in the camera's axes.

    Without `shifts` it only turns.
    """

    def __init__(
        self, rng: np.random.Generator, strength: float = 1.0, *, shifts: bool = True
    ) -> None:
        step = (HIGH_HZ - LOW_HZ) / WAVES
        hz = LOW_HZ + step * (np.arange(WAVES)[:, None] + rng.uniform(0.0, 1.0, (WAVES, 6)))
        rate = rng.rayleigh(1.0, (WAVES, 6)) / (1.0 + (hz / KNEE_HZ) ** 2)
        rate *= np.array(3 * [SPEED_M_S] + 3 * [TURN_RAD_S]) / np.sqrt(0.5 * (rate**2).sum(axis=0))
        self._omega = 2.0 * math.pi * hz
        self._amplitude = strength * rate / self._omega
        if not shifts:
            self._amplitude[:, :3] = 0.0
        self._phase = rng.uniform(0.0, 2.0 * math.pi, (WAVES, 6))

    def at(self, times_s: F64) -> tuple[F64, F64]:
        """Shift (n, 3) [m] and rotation vector (n, 3) [rad] at times (n,)."""
        angle = times_s[:, None, None] * self._omega + self._phase
        both = (self._amplitude * np.sin(angle)).sum(axis=1)
        return both[:, :3], both[:, 3:]
