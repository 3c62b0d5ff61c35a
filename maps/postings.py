# SPDX-License-Identifier: Apache-2.0
"""The inverted index of some images, from their histograms of words."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.tiles.index import BowVector, InvertedIndex, InvertedSegment
from edge.types import F32

MAX_KEYFRAMES = 1 << 16  # of one index: postings hold a uint16


class Postings(NamedTuple):
    """For every word the keyframes that show it, in order."""

    offsets: NDArray[np.uint32]  # (n_words + 1,)
    keyframe: NDArray[np.uint16]  # (b,)
    weight: F32  # (b,)


def invert(vectors: list[BowVector], n_words: int) -> Postings:
    """Postings of the keyframes 0 to len(vectors) - 1."""
    words = np.concatenate([np.empty(0, np.int32), *(vector.words for vector in vectors)])
    weights = np.concatenate([np.empty(0, np.float32), *(vector.weights for vector in vectors)])
    keyframes = np.repeat(np.arange(len(vectors)), [len(vector.words) for vector in vectors])
    order = np.argsort(words, kind="stable")
    counts = np.bincount(words, minlength=n_words)
    return Postings(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.uint32),
        keyframes[order].astype(np.uint16),
        weights[order],
    )


def index_of(vectors: list[BowVector], n_words: int) -> InvertedIndex:
    """The index of images 0 to len(vectors) - 1, however many."""
    segments = []
    for base in range(0, len(vectors), MAX_KEYFRAMES):
        part = vectors[base : base + MAX_KEYFRAMES]
        segments.append(InvertedSegment(base, len(part), *invert(part, n_words)))
    return InvertedIndex(segments)
