# SPDX-License-Identifier: Apache-2.0
"""Which keyframes show the same words as an image, best first."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.tiles.kernels import add_common_weight
from edge.types import F32, I32


class BowVector(NamedTuple):
    """An image as a histogram of visual words."""

    words: I32  # (n,) ascending, each once
    weights: F32  # (n,) positive, of sum 1


class InvertedSegment(NamedTuple):
    """The postings of one tile: for every word the keyframes that show it."""

    base: int  # global index of the tile's first keyframe
    n_keyframes: int
    offsets: NDArray[np.uint32]  # (words + 1,)
    keyframe: NDArray[np.uint16]  # (b,) within the tile
    weight: F32  # (b,)


class InvertedIndex:
    """The inverted index of a whole map. Queries share no state: any thread may ask."""

    def __init__(
        self, segments: list[InvertedSegment], searched: Callable[[int], None] | None = None
    ) -> None:
        """`searched` is told which segment a search has just been through."""
        self._segments = segments
        self._searched = searched
        self.n_keyframes = sum(segment.n_keyframes for segment in segments)

    def scores(self, vector: BowVector) -> F32:
        """L1 score in [0, 1] of every keyframe, (n_keyframes,) float32.

        1 - |a - b|_1 / 2 of two histograms of sum 1 is the sum of their smaller entries, so
        only words that both hold count.
        """
        scores = np.zeros(self.n_keyframes, np.float32)
        for order, (base, count, offsets, keyframe, weight) in enumerate(self._segments):
            out = scores[base : base + count]
            add_common_weight(vector.words, vector.weights, offsets, keyframe, weight, count, out)
            if self._searched is not None:
                self._searched(order)
        return scores

    def query(self, vector: BowVector, k: int) -> tuple[I32, F32]:
        """Return the best `k` keyframes, ids (m,) and scores (m,), best first.

        Keyframes without a common word are left out; of equal scores the lower id is first.
        """
        scores = self.scores(vector)
        order = np.argsort(-scores, kind="stable")[:k].astype(np.int32)
        order = order[scores[order] > 0.0]
        return order, scores[order]
