# SPDX-License-Identifier: Apache-2.0
"""The vocabulary that makes a short histogram of an image's descriptors."""

import functools
import hashlib
import mmap
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.errors import TileError
from edge.relocalise import kernels_bow
from edge.tiles import format as tile_format
from edge.tiles.index import BowVector
from edge.tiles.learned import LearnedMap
from edge.tiles.reader import Map
from edge.tiles.tile import map_file
from edge.types import F32, I32, U8

SHIPPED = Path(__file__).with_name("vocabulary.tile")
_MAX_NODES = 1 << 22


class Vocabulary:
    """A tree of binary centres; its leaves are the words. Any thread may use it.

    `id` is the sha256 of its file: a map can be asked only by the vocabulary that it names.
    """

    def __init__(self, data: bytes | mmap.mmap, origin: str) -> None:
        arrays, self.metadata = tile_format.decode(memoryview(data), origin)
        self.id = hashlib.sha256(data).hexdigest()
        self._nodes: NDArray[np.uint64] = _layer(arrays, "nodes", "u1", 2, origin).view(np.uint64)
        self._first_child: I32 = _layer(arrays, "first_child", "<i4", 1, origin)
        self._n_children: U8 = _layer(arrays, "n_children", "u1", 1, origin)
        self._word: I32 = _layer(arrays, "word", "<i4", 1, origin)
        self.idf: F32 = _layer(arrays, "idf", "<f4", 1, origin)  # (n_words,)
        self._check(origin)

    @classmethod
    def load(cls, path: Path) -> "Vocabulary":
        """Read a vocabulary file; TileError if it is none."""
        return cls(map_file(path), str(path))

    @property
    def n_words(self) -> int:
        """How many words there are."""
        return len(self.idf)

    def quantise(self, descriptors: U8) -> I32:
        """Word (n,) int32 of each descriptor (n, 32) uint8."""
        words = np.empty(len(descriptors), np.int32)
        rows = np.ascontiguousarray(descriptors).view(np.uint64)
        kernels_bow.quantise(
            rows, self._nodes, self._first_child, self._n_children, self._word, words
        )
        return words

    def vector(self, words: I32) -> BowVector:
        """Histogram of the words (n,) of an image: tf-idf weights of sum 1."""
        distinct, counts = np.unique(words, return_counts=True)
        weights = counts * self.idf[distinct]
        total = weights.sum()
        if total <= 0.0:
            return BowVector(np.empty(0, np.int32), np.empty(0, np.float32))
        return BowVector(distinct.astype(np.int32), (weights / total).astype(np.float32))

    def describe(self, descriptors: U8) -> BowVector:
        """Histogram of an image's descriptors (n, 32) uint8."""
        return self.vector(self.quantise(descriptors))

    def _check(self, origin: str) -> None:
        """TileError unless every walk ends at a leaf that is a word."""
        n = len(self._nodes)
        row = np.arange(n)
        inner = self._n_children > 0
        ends = self._first_child.astype(np.int64) + self._n_children
        sound = (
            0 < n <= _MAX_NODES
            and {len(self._first_child), len(self._n_children), len(self._word)} == {n}
            and bool(np.all(self._first_child[inner] > row[inner]))
            and bool(np.all(ends[inner] <= n))
            and bool(np.all((self._word[~inner] >= 0) & (self._word[~inner] < self.n_words)))
            and bool(np.all(np.isfinite(self.idf) & (self.idf >= 0.0)))
        )
        if not sound:
            raise TileError(f"{origin}: its tree is damaged; install the program again")


def vocabulary_of(map_: Map) -> Vocabulary:
    """The vocabulary of a map's words: the shipped one, or that of its learned features."""
    if isinstance(map_, LearnedMap):
        vocabulary = Vocabulary.load(map_.vocabulary_file)
    else:
        vocabulary = shipped_vocabulary()
    named = map_.manifest.vocabulary
    if (vocabulary.id, vocabulary.n_words) != (named.id, named.words):
        raise TileError(f"{map_.folder} was built with another vocabulary; build it again")
    return vocabulary


@functools.cache
def shipped_vocabulary() -> Vocabulary:
    """The vocabulary of every map, part of this package."""
    return Vocabulary.load(SHIPPED)


def _layer(
    arrays: dict[str, tile_format.Array], name: str, dtype: str, ndim: int, origin: str
) -> tile_format.Array:
    array = arrays.get(name)
    if array is None or array.dtype != np.dtype(dtype) or array.ndim != ndim:
        raise TileError(f"{origin} is no vocabulary: {name} is missing or of another type")
    if ndim == 2 and array.shape[1] != 32:
        raise TileError(f"{origin} is no vocabulary for descriptors of 32 bytes")
    return array
