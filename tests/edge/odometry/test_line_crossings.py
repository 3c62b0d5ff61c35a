# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.odometry.line_crossings import crossings, still_meet

BOARD = np.array(
    [[10.0, 10.0, 90.0, 12.0], [92.0, 10.0, 90.0, 60.0], [91.0, 61.0, 11.0, 60.0]]
)  # an open box: two corners
SHELF = np.array([[50.0, 61.0, 50.0, 120.0]])  # ends in the middle of the board's last edge


def test_edges_meet_where_their_ends_do() -> None:
    found = crossings(np.vstack((BOARD, SHELF)))
    assert sorted(zip(found.one, found.other, strict=True)) == [(0, 1), (1, 2)]
    np.testing.assert_allclose(found.pixels, [[92, 12], [90, 61]], atol=0.5)


def test_parallel_edges_meet_nowhere() -> None:
    # A broken piece of an edge begins where the other ends.
    assert len(crossings(np.array([[10.0, 10, 50, 10], [51.0, 10, 90, 10.5]])).one) == 0


def test_what_is_hidden_later_does_not_meet() -> None:
    found = crossings(BOARD)
    shorter, hidden = BOARD.copy(), BOARD.copy()
    shorter[0, 2:] = [60.0, 11.25]
    hidden[2] = np.nan
    assert still_meet(BOARD + 3.0, found).tolist() == [True, True]
    assert still_meet(shorter, found).tolist() == [False, True]
    assert still_meet(hidden, found).tolist() == [True, False]
