# SPDX-License-Identifier: Apache-2.0
"""Trains the vocabulary: a tree of k-majority clusters over binary descriptors."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from edge.relocalise.bow import Vocabulary
from edge.tiles import format as tile_format
from edge.types import F32, U8
from maps import kernels_vocabulary as kernels

_MAX_ROUNDS = 15  # k-majority settles in fewer
_Rows = NDArray[np.int64]


@dataclass
class _Tree:
    """Nodes in breadth-first order, so that children are consecutive and behind their parent."""

    centre: list[U8] = field(default_factory=list)
    first_child: list[int] = field(default_factory=list)
    n_children: list[int] = field(default_factory=list)
    word: list[int] = field(default_factory=list)

    def add(self, centre: U8) -> int:
        self.centre.append(centre)
        self.first_child.append(0)
        self.n_children.append(0)
        self.word.append(-1)
        return len(self.centre) - 1


def train(
    descriptors: U8,
    images: NDArray[np.int32],
    *,
    branching: int = 10,
    depth: int = 4,
    seed: int = 0,
    origin: str = "",
) -> bytes:
    """Return the bytes of a vocabulary file; the same input gives the same bytes.

    Parameters
    ----------
    descriptors : (n, 32) uint8
    images : (n,) int32, the image that each descriptor is from; for the words' weights
    branching, depth : children of a node, and levels below the root
    seed : of the first centres
    origin : what the images were, for the file's metadata
    """
    tree = _grow(np.ascontiguousarray(descriptors), branching, depth, np.random.default_rng(seed))
    n_words = max(tree.word) + 1
    arrays: dict[str, tile_format.Array] = {
        "nodes": np.array(tree.centre, np.uint8),
        "first_child": np.array(tree.first_child, np.int32),
        "n_children": np.array(tree.n_children, np.uint8),
        "word": np.array(tree.word, np.int32),
        "idf": np.ones(n_words, np.float32),
    }
    metadata = {
        "kind": "mapvo vocabulary 1",
        "branching": str(branching),
        "depth": str(depth),
        "seed": str(seed),
        "origin": origin,
    }
    unweighted = Vocabulary(tile_format.encode(arrays, metadata), "the new vocabulary")
    arrays["idf"] = _inverse_document_frequency(unweighted.quantise(descriptors), images, n_words)
    return tile_format.encode(arrays, metadata)


def _grow(descriptors: U8, branching: int, depth: int, rng: np.random.Generator) -> _Tree:
    tree = _Tree()
    queue: deque[tuple[int, _Rows, int]] = deque()
    queue.append((tree.add(np.zeros(32, np.uint8)), np.arange(len(descriptors)), 0))
    n_words = 0
    while queue:
        node, rows, level = queue.popleft()
        clusters = _cluster(descriptors, rows, branching, rng) if level < depth else []
        if len(clusters) < 2:
            tree.word[node] = n_words
            n_words += 1
            continue
        children = [(tree.add(centre), members, level + 1) for centre, members in clusters]
        tree.first_child[node] = children[0][0]
        tree.n_children[node] = len(children)
        queue.extend(children)
    return tree


def _cluster(
    descriptors: U8, rows: _Rows, k: int, rng: np.random.Generator
) -> list[tuple[U8, _Rows]]:
    """Centres (32,) and members (m,) of at most `k` clusters; empty if there are too few rows."""
    if len(rows) < 2 * k:
        return []
    words = descriptors.view(np.uint64)
    centres = _first_centres(descriptors, rows, k, rng)
    labels = np.full(len(rows), -1, np.int32)
    for _ in range(_MAX_ROUNDS):
        previous = labels.copy()
        kernels.assign(words, rows, centres.view(np.uint64), labels, np.empty_like(labels))
        if np.array_equal(labels, previous):
            break
        ones = np.zeros((len(centres), 256), np.int64)
        members = np.zeros(len(centres), np.int64)
        kernels.count_bits(descriptors, rows, labels, ones, members)
        majority = np.packbits(2 * ones > members[:, None], axis=1, bitorder="little")
        centres = np.where(members[:, None] > 0, majority, centres)
    members_of = [rows[labels == label] for label in range(len(centres))]
    return [
        (centre, members)
        for centre, members in zip(centres, members_of, strict=True)
        if len(members)
    ]


def _first_centres(descriptors: U8, rows: _Rows, k: int, rng: np.random.Generator) -> U8:
    """Distinct members (m <= k, 32), each likelier the farther from those before (k-means++)."""
    words = descriptors.view(np.uint64)
    chosen = [descriptors[rows[rng.integers(len(rows))]]]
    nearest = np.full(len(rows), 257, np.int32)
    label, distance = np.empty_like(nearest), np.empty_like(nearest)
    while len(chosen) < k:
        newest = np.ascontiguousarray(chosen[-1])[None].view(np.uint64)
        kernels.assign(words, rows, newest, label, distance)
        nearest = np.minimum(nearest, distance)
        total = np.cumsum(nearest.astype(np.int64) ** 2)
        if total[-1] == 0:
            break
        chosen.append(descriptors[rows[np.searchsorted(total, rng.integers(total[-1]), "right")]])
    return np.array(chosen)


def _inverse_document_frequency(
    words: NDArray[np.int32], images: NDArray[np.int32], n_words: int
) -> F32:
    """Weight (n_words,): ln of all images over those that show the word."""
    seen = np.unique(np.stack((words, images), axis=1), axis=0)
    shown = np.bincount(seen[:, 0], minlength=n_words)
    n_images = len(np.unique(images))
    # A word that every image shows says nothing; a small rest keeps a lone such image alive.
    return np.log((n_images + 1.0) / np.maximum(shown, 1)).astype(np.float32)
