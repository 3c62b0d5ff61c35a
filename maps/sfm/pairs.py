# SPDX-License-Identifier: Apache-2.0
"""Which images are worth matching where nothing but the images is known."""

import numpy as np

from edge.tiles.index import BowVector
from maps.postings import index_of

SIMILAR = 20  # images matched with each: the most alike by their words
FOLLOWING = 2  # and the next ones, where the order says something


def choose_pairs(words: list[BowVector], n_words: int) -> list[tuple[int, int]]:
    """Pairs (i, j) with i < j, ascending: of each image the most alike ones.

    Where the next image is mostly among those, the images are in the order of a drive; then the
    next ones are taken wherever they look otherwise, as in a quick turn.
    """
    index = index_of(words, n_words)
    pairs: set[tuple[int, int]] = set()
    follows = 0
    for i, vector in enumerate(words):
        scores = index.scores(vector)
        scores[i] = 0.0
        alike = [int(j) for j in np.argsort(-scores, kind="stable")[:SIMILAR] if scores[j] > 0.0]
        follows += i + 1 in alike
        pairs.update((min(i, j), max(i, j)) for j in alike)
    if 2 * follows > len(words):
        for i in range(len(words)):
            pairs.update((i, j) for j in range(i + 1, min(len(words), i + 1 + FOLLOWING)))
    return sorted(pairs)
