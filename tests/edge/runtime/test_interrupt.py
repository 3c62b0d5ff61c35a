# SPDX-License-Identifier: Apache-2.0
import signal
from collections.abc import Iterator

import pytest

from edge.runtime.interrupt import SIGNALS, stop_on_signal


class Wishes:
    """What signals did."""

    def __init__(self) -> None:
        self.stops = self.breaks = 0
        self.now_s = 100.0

    def stop(self) -> None:
        self.stops += 1

    def break_off(self, *_: object) -> None:
        self.breaks += 1

    def clock_s(self) -> float:
        return self.now_s


@pytest.fixture
def wishes() -> Iterator[Wishes]:
    made = Wishes()
    usual = {number: signal.signal(number, made.break_off) for number in SIGNALS}
    yield made
    for number, handler in usual.items():
        signal.signal(number, handler)


def test_a_signal_that_comes_twice_at_once_stops_and_breaks_off_nothing(wishes: Wishes) -> None:
    with stop_on_signal(wishes.stop, wishes.clock_s) as interruption:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
    signal.raise_signal(signal.SIGINT)  # while things are put in order
    assert interruption.came
    assert (wishes.stops, wishes.breaks) == (1, 0)


def test_a_later_signal_breaks_off(wishes: Wishes) -> None:
    with stop_on_signal(wishes.stop, wishes.clock_s):
        signal.raise_signal(signal.SIGINT)
        wishes.now_s += 5.0
        signal.raise_signal(signal.SIGINT)
    signal.raise_signal(signal.SIGTERM)
    assert (wishes.stops, wishes.breaks) == (1, 2)


def test_without_a_signal_all_is_as_before(wishes: Wishes) -> None:
    with stop_on_signal(wishes.stop, wishes.clock_s) as interruption:
        pass
    signal.raise_signal(signal.SIGINT)
    assert not interruption.came
    assert (wishes.stops, wishes.breaks) == (0, 1)
