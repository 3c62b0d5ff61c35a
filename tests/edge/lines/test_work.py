# SPDX-License-Identifier: Apache-2.0
from itertools import count

from edge.lines.work import LineWork
from edge.types import LineSearch


def test_searches_are_told_once_with_their_time() -> None:
    work = LineWork(count(0, 2_000_000).__next__)
    for segments in (7, 0):
        work.add(segments, work.clock())
    assert work.take() == (LineSearch(7, 2.0), LineSearch(0, 2.0))
    assert work.take() == ()


def test_without_a_clock_searches_are_counted_all_the_same() -> None:
    work = LineWork()
    work.add(3, work.clock())
    assert work.take() == (LineSearch(3, 0.0),)


def test_what_nobody_takes_does_not_pile_up() -> None:
    work = LineWork()
    for segments in range(1000):
        work.add(segments, 0)
    taken = work.take()
    assert len(taken) < 100
    assert taken[-1].segments == 999
