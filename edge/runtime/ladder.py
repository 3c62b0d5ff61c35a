# SPDX-License-Identifier: Apache-2.0
"""What is given up when the device is too hot, too weakly fed or too slow, and for how long."""

import enum
from typing import NamedTuple

from edge.config import Config
from edge.config.ladder import LadderConfig

_MOST_WAIT_S = 600.0


class Step(enum.Enum):
    """What may be given up, in this order; the value is what people are told."""

    CHANGES = "changes are not looked for"
    RELOCALISE_LESS = "the map is searched less often"
    LEAN = "lean odometry"
    HALF_RATE = "every second frame"


def steps_of(config: Config) -> tuple[Step, ...]:
    """What a device of these settings has that may be given up."""
    steps = [Step.CHANGES] if config.segmenter.model or config.changes.without_model else []
    steps.append(Step.RELOCALISE_LESS)
    if config.odometry.preset != "lean":
        steps.append(Step.LEAN)
    return (*steps, Step.HALF_RATE)


class Reading(NamedTuple):
    """How it goes, over the last second or so."""

    temperature_c: float | None  # None where there is no sensor
    busy_share: float  # of a frame's interval that its tracking takes
    dropped_share: float  # of frames that were overtaken
    under_voltage: bool = False  # the board says that its supply is too weak


class Ladder:
    """Goes one step down after lasting trouble, and one up after a lasting rest.

    A step up that soon had to be taken back makes the next one wait twice as long.
    Owned by one thread; the time comes from the caller.
    """

    def __init__(self, config: LadderConfig, steps: tuple[Step, ...]) -> None:
        self._config = config
        self._steps = steps if config.enabled else ()
        self._level = 0
        self._since_ns: int | None = None  # of the trouble or rest that lasts now
        self._resting = False
        self._up_ns: int | None = None  # of the last step up
        self._wait_s = config.up_after_s
        self.reasons: tuple[str, ...] = ()

    @property
    def given_up(self) -> tuple[Step, ...]:
        """The steps that are taken now."""
        return self._steps[: self._level]

    def step(self, now_ns: int, reading: Reading) -> bool:
        """Take in a reading; say whether a step was taken."""
        trouble = self._trouble(reading)
        if trouble:
            self.reasons = trouble
        elif self._level == 0:
            self.reasons = ()
        resting = not trouble and self._is_at_rest(reading)
        if not trouble and not resting:
            self._since_ns = None
            return False
        if self._since_ns is None or resting is not self._resting:
            self._since_ns, self._resting = now_ns, resting
        lasted_s = (now_ns - self._since_ns) * 1e-9
        if resting:
            return self._level > 0 and lasted_s >= self._wait_s and self._go_up(now_ns)
        enough = lasted_s >= self._config.down_after_s
        return enough and self._level < len(self._steps) and self._go_down(now_ns)

    def _go_down(self, now_ns: int) -> bool:
        config = self._config
        if self._up_ns is not None and now_ns - self._up_ns < self._wait_s * 1e9:
            self._wait_s = min(2.0 * self._wait_s, _MOST_WAIT_S)
        else:
            self._wait_s = config.up_after_s
        self._level += 1
        self._since_ns = None
        return True

    def _go_up(self, now_ns: int) -> bool:
        self._level -= 1
        self._since_ns, self._up_ns = None, now_ns
        return True

    def _trouble(self, reading: Reading) -> tuple[str, ...]:
        config, reasons = self._config, []
        if reading.temperature_c is not None and reading.temperature_c >= config.hot_c:
            reasons.append(f"hot: {reading.temperature_c:.0f} C")
        if reading.under_voltage:
            reasons.append("under-voltage: the supply is too weak for the board")
        if reading.busy_share >= config.busy_share:
            reasons.append(f"slow: tracking takes {reading.busy_share:.0%} of a frame's time")
        if reading.dropped_share >= config.dropped_share:
            reasons.append(f"slow: {reading.dropped_share:.0%} of the frames were overtaken")
        return tuple(reasons)

    def _is_at_rest(self, reading: Reading) -> bool:
        config = self._config
        # Twice as many frames will take twice the share.
        frames_more = 2.0 if Step.HALF_RATE in self.given_up else 1.0
        cool = reading.temperature_c is None or reading.temperature_c <= config.cool_c
        return (
            cool
            and reading.busy_share * frames_more <= config.idle_share
            and reading.dropped_share == 0.0
        )
