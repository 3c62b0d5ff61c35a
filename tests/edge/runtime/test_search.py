# SPDX-License-Identifier: Apache-2.0
import threading
import time

import numpy as np
import pytest

from edge.runtime.search import DelayedSearch, ThreadedSearch, timed_step
from edge.types import Fix, Frame, Query
from tests.edge.runtime.scripted import TrueRelocaliser

PATIENCE_S = 60.0
IMAGE = np.zeros((2, 2), np.uint8)


def query(index: int) -> Query:
    return Query(Frame(index, index, IMAGE))


def run_delayed(
    delay_frames: int, offered: list[int], frames: int, relocaliser: TrueRelocaliser | None = None
) -> dict[int, list[int]]:
    """Indices of the fixes that took effect, by the frame at which they did."""
    search = DelayedSearch(relocaliser or TrueRelocaliser(), delay_frames, time.thread_time_ns)
    effects = {}
    for frame in range(frames):
        if fixes := search.drain(frame):
            effects[frame] = [fix.index for fix in fixes]
        if frame in offered:
            search.offer(query(frame))
    return effects


@pytest.mark.parametrize("delay_frames", [1, 3, 10])
def test_fix_takes_effect_exactly_so_many_frames_after_its_query(delay_frames: int) -> None:
    assert run_delayed(delay_frames, [5], 30) == {5 + delay_frames: [5]}


@pytest.mark.parametrize(
    ("period_ns", "after"),
    [(33_000_000, 3), (50_000_000, 2), (49_950_000, 2), (99_700_000, 1), (200_000_000, 1)],
)
@pytest.mark.parametrize("sign", [1, -1], ids=["forwards", "backwards"])
def test_where_frames_come_seldom_it_is_a_time(period_ns: int, after: int, sign: int) -> None:
    search = DelayedSearch(TrueRelocaliser(), 3, time.thread_time_ns, 0.1)
    effects = []
    for frame in range(12):
        if search.drain(sign * frame * period_ns):
            effects.append(frame)
        if frame == 5:
            search.offer(query(frame))
    assert effects == [5 + after]


def test_newest_waiting_query_follows_the_one_under_way() -> None:
    assert run_delayed(4, [2, 3, 4, 5], 30) == {6: [2], 10: [5]}


def test_query_in_the_frame_of_an_effect_is_taken_up_at_once() -> None:
    assert run_delayed(3, [2, 5], 30) == {5: [2], 8: [5]}


def test_busy_thread_gets_the_newest_query_and_nobody_waits() -> None:
    gate = threading.Event()

    class Slow(TrueRelocaliser):
        def step(self, query: Query) -> Fix:
            begun.set()
            gate.wait(PATIENCE_S)
            return super().step(query)

    begun, relocaliser = threading.Event(), Slow()
    search = ThreadedSearch(relocaliser, time.monotonic_ns)
    search.offer(query(0))
    assert begun.wait(PATIENCE_S)
    for index in range(1, 100):  # who waited would do so for ever
        search.offer(query(index))
        assert search.drain(0) == []
    gate.set()
    search.close()
    assert [asked.frame.index for asked in relocaliser.asked] == [0, 99]
    assert search.dropped == 98
    assert [fix.index for fix in search.drain(0)] == [q.frame.index for q in relocaliser.asked]


def test_fixes_carry_their_duration() -> None:
    class Slow(TrueRelocaliser):
        def step(self, query: Query) -> Fix:
            time.sleep(0.03)
            return super().step(query)

    search = ThreadedSearch(Slow(), time.monotonic_ns)
    search.offer(query(0))
    search.close()
    (fix,) = search.drain(0)
    assert fix.ms >= 30.0


def test_numbers_that_break_down_find_nothing_and_the_next_query_is_tried(
    caplog: pytest.LogCaptureFixture,
) -> None:
    class Moody(TrueRelocaliser):
        def step(self, query: Query) -> Fix:
            if query.frame.index == 0:
                np.linalg.inv(np.zeros((2, 2)))
            return super().step(query)

    assert run_delayed(3, [0, 5], 30, Moody()) == {3: [0], 8: [5]}
    assert "event=relocalise_broke_down index=0" in caplog.text
    assert not timed_step(Moody(), query(0), time.thread_time_ns).found


def test_failure_in_the_thread_reaches_the_pipeline() -> None:
    class Broken(TrueRelocaliser):
        def step(self, query: Query) -> Fix:
            raise ZeroDivisionError

    search = ThreadedSearch(Broken(), time.monotonic_ns)
    search.offer(query(0))
    search.close()
    with pytest.raises(ZeroDivisionError):
        search.drain(0)
