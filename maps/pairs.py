# SPDX-License-Identifier: Apache-2.0
"""Which views are worth matching: those that look alike and could see the same."""

import numpy as np

from edge.tiles.index import BowVector
from edge.types import Mat4
from maps.postings import index_of
from maps.settings import BuildSettings


def choose_pairs(
    poses: list[Mat4], words: list[BowVector], n_words: int, settings: BuildSettings
) -> list[tuple[int, int]]:
    """Pairs (i, j) with i < j, ascending: of each view the most alike ones and the next in order.

    The words need no scale and no depth; the poses leave out those that look elsewhere.
    """
    index = index_of(words, n_words)
    axes = np.array([pose[:3, 2] for pose in poses])
    least_cosine = np.cos(np.deg2rad(settings.max_view_angle_deg))
    pairs: set[tuple[int, int]] = set()
    for i, vector in enumerate(words):
        scores = index.scores(vector)
        scores[axes @ axes[i] < least_cosine] = 0.0
        scores[i] = 0.0
        alike = np.argsort(-scores, kind="stable")[: settings.similar_views]
        others = [int(j) for j in alike if scores[j] > 0.0]
        others += range(i + 1, min(len(words), i + 1 + settings.following_views))
        pairs.update((min(i, j), max(i, j)) for j in others)
    return sorted(pairs)
