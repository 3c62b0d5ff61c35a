# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.tiles.index import BowVector
from maps.sfm.pairs import FOLLOWING, SIMILAR, choose_pairs


def image(words: list[int]) -> BowVector:
    found = np.unique(np.array(words, np.int32))
    return BowVector(found, np.full(len(found), 1.0 / len(found), np.float32))


def drive(n: int) -> list[BowVector]:
    """Images that share words with their 30 neighbours on each side."""
    return [image(list(range(10 * i, 10 * i + 300))) for i in range(n)]


def test_every_image_is_paired_with_the_most_alike() -> None:
    pairs = choose_pairs(drive(60), 2000)
    assert pairs == sorted(set(pairs))
    assert all(i < j for i, j in pairs)
    # In the middle of a drive the most alike are the ten on each side.
    of_30 = {j - i for i, j in pairs if i == 30}
    assert of_30 == set(range(1, SIMILAR // 2 + 1))


def test_the_next_in_order_are_taken_where_they_look_otherwise() -> None:
    words = drive(60)
    words[30] = image([1900, 1901])  # a quick turn: nothing in common
    pairs = choose_pairs(words, 2000)
    assert {(30 - k, 30) for k in range(1, FOLLOWING + 1)} <= set(pairs)
    assert {(30, 30 + k) for k in range(1, FOLLOWING + 1)} <= set(pairs)


def test_images_in_no_order_are_not_paired_by_their_order() -> None:
    order = np.random.default_rng(0).permutation(60)
    words = drive(60)
    pairs = choose_pairs([words[k] for k in order], 2000)
    assert all(abs(order[i] - order[j]) <= SIMILAR for i, j in pairs)
    assert not all((i, i + 1) in pairs for i in range(59))


def test_images_without_words_make_no_pairs_of_their_own() -> None:
    words = [
        image([1, 2]),
        image([1, 2]),
        BowVector(np.empty(0, np.int32), np.empty(0, np.float32)),
    ]
    assert (0, 1) in choose_pairs(words, 10)
    assert choose_pairs(words[2:] * 3, 10) == []
