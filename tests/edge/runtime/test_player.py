# SPDX-License-Identifier: Apache-2.0
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import pytest

from edge.errors import RecordingError
from edge.runtime.player import Arrival, OfflinePlayer, RealTimePlayer
from edge.types import Frame
from tests.edge.runtime.scripted import PERIOD_NS, FrameList


def test_offline_play_gives_every_frame() -> None:
    arrivals = list(OfflinePlayer(FrameList(10)))
    assert [arrival.frame.index for arrival in arrivals] == list(range(10))
    assert all(arrival.captured_ns is None for arrival in arrivals)


@dataclass
class Gated(FrameList):
    """The next frame is read once the last one was taken, so that none is overtaken."""

    gate: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(1))

    def __iter__(self) -> Iterator[Frame]:
        for frame in self.ordered():
            self.gate.acquire()
            yield frame

    def ordered(self) -> Iterator[Frame]:
        return super().__iter__()


class Backwards(Gated):
    def ordered(self) -> Iterator[Frame]:
        return iter(list(super().ordered())[::-1])


def play_all(camera: Gated) -> list[Arrival]:
    arrivals = []
    for arrival in RealTimePlayer(camera):
        arrivals.append(arrival)
        camera.gate.release()
    return arrivals


@pytest.mark.parametrize("camera", [Gated(4), Backwards(4)], ids=["forth", "back"])
def test_real_time_play_keeps_the_recorded_intervals(camera: Gated) -> None:
    began_ns = time.monotonic_ns()
    arrivals = play_all(camera)
    captured = [arrival.captured_ns or 0 for arrival in arrivals]
    assert all(began_ns < at <= time.monotonic_ns() for at in captured)
    recorded = [arrival.frame.t_ns for arrival in arrivals]
    assert recorded == [frame.t_ns for frame in camera.ordered()]
    assert [b - a for a, b in pairwise(captured)] == [abs(b - a) for a, b in pairwise(recorded)]


def test_slow_taker_gets_the_newest_and_the_loss_is_counted() -> None:
    player = RealTimePlayer(FrameList(12))
    arrivals = iter(player)
    indices = [next(arrivals).frame.index]
    while player.dropped < 10:  # until the last one waits
        time.sleep(PERIOD_NS * 1e-9)
    indices += [arrival.frame.index for arrival in arrivals]
    player.close()
    assert indices[-1] == 11
    assert len(indices) <= 2
    assert len(indices) + player.dropped == 12


def test_closing_does_not_wait_for_a_gap_in_the_recording() -> None:
    @dataclass
    class Gap(FrameList):
        def __iter__(self) -> Iterator[Frame]:
            for frame in super().__iter__():
                yield Frame(frame.index, frame.index * 3_600_000_000_000, frame.image)

    player = RealTimePlayer(Gap(3))
    next(iter(player))
    player.close()  # else this takes an hour


def test_trouble_with_the_recording_reaches_the_taker() -> None:
    @dataclass
    class Torn(FrameList):
        def __iter__(self) -> Iterator[Frame]:
            yield from super().__iter__()
            raise RecordingError("film torn")

    player = RealTimePlayer(Torn(2))
    with pytest.raises(RecordingError, match="film torn"):
        list(player)
    player.close()
