# SPDX-License-Identifier: Apache-2.0
from edge.segmenter.backoff import Backoff


def test_waits_double_up_to_the_longest() -> None:
    backoff = Backoff(1.0, 6.0)

    assert [backoff.fail() for _ in range(5)] == [1.0, 2.0, 4.0, 6.0, 6.0]


def test_one_success_does_not_shorten_the_wait_but_many_do() -> None:
    backoff = Backoff(1.0, 60.0)
    backoff.fail()
    backoff.fail()
    backoff.succeed()
    assert backoff.fail() == 4.0

    for _ in range(10):
        backoff.succeed()

    assert backoff.fail() == 1.0
