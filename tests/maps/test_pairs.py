# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.geometry import se3
from edge.tiles.index import BowVector
from maps.pairs import choose_pairs
from maps.settings import BuildSettings

N_WORDS = 50


def vector(*words: int) -> BowVector:
    weights = np.full(len(words), 1.0 / len(words), np.float32)
    return BowVector(np.array(words, np.int32), weights)


def pairs(words: list[BowVector], turns: list[float], **settings: float) -> list[tuple[int, int]]:
    poses = [se3.exp([0, 0, 0, 0, turn, 0]) for turn in turns]
    return choose_pairs(poses, words, N_WORDS, BuildSettings(**settings))  # type: ignore[arg-type]


def test_views_that_look_alike_are_matched_most_alike_first() -> None:
    words = [vector(1, 2, 3), vector(1, 2, 4), vector(7, 8, 9), vector(1, 8, 9)]
    chosen = pairs(words, [0.0] * 4, similar_views=1, following_views=0)
    assert chosen == [(0, 1), (2, 3)]


def test_neighbours_in_time_are_matched_whatever_they_look_like() -> None:
    words = [vector(number) for number in range(4)]
    chosen = pairs(words, [0.0] * 4, similar_views=5, following_views=2)
    assert chosen == [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]


def test_views_that_look_elsewhere_are_left_out() -> None:
    words = [vector(1, 2)] * 3
    chosen = pairs(words, [0.0, 0.5, 2.0], similar_views=5, following_views=0)
    assert chosen == [(0, 1)]


def test_one_view_alone_has_no_pair() -> None:
    assert pairs([vector(1)], [0.0]) == []
