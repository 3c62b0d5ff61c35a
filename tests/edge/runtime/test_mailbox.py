# SPDX-License-Identifier: Apache-2.0
import threading

import numpy as np
import pytest

from edge.runtime.mailbox import Mailbox


@pytest.mark.parametrize("seed", range(20))
def test_mailbox_keeps_the_newest_in_order_and_counts_the_rest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    capacity = int(rng.integers(1, 5))
    mailbox: Mailbox[int] = Mailbox(capacity)
    kept: list[int] = []
    dropped = 0
    for item in range(200):
        if rng.random() < 0.7:
            mailbox.offer(item)
            kept.append(item)
            dropped += len(kept) > capacity
            kept = kept[-capacity:]
        elif rng.random() < 0.5:
            assert mailbox.drain() == kept
            kept = []
        elif kept:
            assert mailbox.take() == kept.pop(0)
        assert mailbox.dropped == dropped


def test_nothing_is_lost_silently_between_threads() -> None:
    mailbox: Mailbox[int] = Mailbox(3)
    taken: list[int] = []

    def reader() -> None:
        while (item := mailbox.take()) is not None:
            taken.append(item)

    thread = threading.Thread(target=reader)
    thread.start()
    for item in range(5000):
        mailbox.offer(item)
    mailbox.close()
    thread.join()
    assert taken == sorted(taken)
    assert taken[-1] == 4999  # the newest always arrives
    assert len(taken) + mailbox.dropped == 5000


def test_take_waits_for_an_item() -> None:
    mailbox: Mailbox[str] = Mailbox()
    timer = threading.Timer(0.02, mailbox.offer, ["late"])
    timer.start()
    assert mailbox.take() == "late"
    timer.join()


def test_closed_mailbox_gives_what_it_holds_then_none() -> None:
    mailbox: Mailbox[int] = Mailbox()
    mailbox.offer(1)
    mailbox.close()
    mailbox.offer(2)
    assert mailbox.take() == 1
    assert mailbox.take() is None
    assert mailbox.drain() == []


def test_close_wakes_who_waits() -> None:
    mailbox: Mailbox[int] = Mailbox()
    timer = threading.Timer(0.02, mailbox.close)
    timer.start()
    assert mailbox.take() is None
    timer.join()
