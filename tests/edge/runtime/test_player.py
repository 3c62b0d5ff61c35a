import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import pytest

from edge.errors import RecordingError
from edge.runtime.player import OfflinePlayer, RealTimePlayer
from edge.types import Frame
from tests.edge.runtime.scripted import PERIOD_NS, FrameList


def test_offline_play_gives_every_frame() -> None:
    arrivals = list(OfflinePlayer(FrameList(10)))
    assert [arrival.frame.index for arrival in arrivals] == list(range(10))
    assert all(arrival.captured_ns is None for arrival in arrivals)


def test_real_time_play_keeps_the_recorded_intervals() -> None:
    player = RealTimePlayer(FrameList(6))
    arrivals = list(player)  # on a busy machine not all of them
    player.close()
    captured = [arrival.captured_ns or 0 for arrival in arrivals]
    assert all(0 < at <= time.monotonic_ns() for at in captured)
    recorded = [arrival.frame.t_ns for arrival in arrivals]
    assert len(arrivals) > 1
    assert [b - a for a, b in pairwise(captured)] == [b - a for a, b in pairwise(recorded)]


def test_slow_taker_gets_the_newest_and_the_loss_is_counted() -> None:
    player = RealTimePlayer(FrameList(12))
    indices = []
    for arrival in player:
        indices.append(arrival.frame.index)
        time.sleep(4 * PERIOD_NS * 1e-9)
    player.close()
    assert indices[-1] == 11
    assert len(indices) < 6
    assert len(indices) + player.dropped == 12


def test_backward_recording_plays_at_its_intervals() -> None:
    @dataclass
    class Backwards(FrameList):
        def __iter__(self) -> Iterator[Frame]:
            return iter(list(super().__iter__())[::-1])

    began = time.monotonic_ns()
    indices = [arrival.frame.index for arrival in RealTimePlayer(Backwards(4))]
    assert indices == [3, 2, 1, 0]
    assert time.monotonic_ns() - began >= 3 * PERIOD_NS


def test_closing_does_not_wait_for_a_gap_in_the_recording() -> None:
    @dataclass
    class Gap(FrameList):
        def __iter__(self) -> Iterator[Frame]:
            for frame in super().__iter__():
                yield Frame(frame.index, frame.index * 3_600_000_000_000, frame.image)

    player = RealTimePlayer(Gap(3))
    next(iter(player))
    began = time.monotonic()
    player.close()
    assert time.monotonic() - began < 1.0


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
