# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise

import numpy as np
import pytest

from edge.errors import TileError
from edge.relocalise.bow import SHIPPED, Vocabulary, shipped_vocabulary
from edge.tiles import format as tile_format
from edge.tiles.index import BowVector, InvertedIndex, InvertedSegment
from edge.types import U8
from maps.postings import invert

N_WORDS = 200


def some_descriptors(n: int, seed: int = 0) -> U8:
    return np.random.default_rng(seed).integers(0, 256, (n, 32)).astype(np.uint8)


def random_vectors(n: int, seed: int = 0) -> list[BowVector]:
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(n):
        words = np.sort(rng.permutation(N_WORDS)[: rng.integers(5, 60)]).astype(np.int32)
        weights = rng.uniform(0.1, 1.0, len(words))
        made.append(BowVector(words, (weights / weights.sum()).astype(np.float32)))
    return made


def index_of(vectors: list[BowVector], cuts: tuple[int, ...] = ()) -> InvertedIndex:
    borders = [0, *cuts, len(vectors)]
    segments = [
        InvertedSegment(a, b - a, *invert(vectors[a:b], N_WORDS)) for a, b in pairwise(borders)
    ]
    return InvertedIndex(segments)


def paper_score(a: BowVector, b: BowVector) -> float:
    """1 - |a/|a| - b/|b|| / 2 in the L1 norm."""
    dense = np.zeros((2, N_WORDS))
    for row, vector in zip(dense, (a, b), strict=True):
        row[vector.words] = vector.weights / np.abs(vector.weights).sum()
    return float(1.0 - 0.5 * np.abs(dense[0] - dense[1]).sum())


def test_scores_are_those_of_the_paper() -> None:
    vectors = random_vectors(30)
    scores = index_of(vectors).scores(vectors[3])
    assert scores == pytest.approx([paper_score(vectors[3], v) for v in vectors], abs=1e-6)


def test_scores_lie_in_the_unit_interval_and_oneself_is_best() -> None:
    vectors = random_vectors(50)
    index = index_of(vectors)
    for number, vector in enumerate(vectors):
        ids, scores = index.query(vector, 5)
        assert ids[0] == number
        assert scores[0] == pytest.approx(1.0, abs=1e-6)
        assert (np.diff(scores) <= 0.0).all()
        assert scores.min() >= 0.0
        assert scores.max() <= 1.0 + 1e-6


def test_cutting_the_index_into_segments_changes_nothing() -> None:
    vectors = random_vectors(40)
    whole, cut = index_of(vectors), index_of(vectors, (1, 7, 30))
    for vector in vectors:
        assert np.array_equal(whole.scores(vector), cut.scores(vector))


def test_equal_scores_come_in_the_order_of_the_keyframes() -> None:
    vectors = random_vectors(3) * 40
    ids, _ = index_of(vectors).query(vectors[1], 40)
    assert ids.tolist() == list(range(1, 120, 3))


def test_keyframes_without_a_common_word_are_left_out() -> None:
    a = BowVector(np.array([1, 2], np.int32), np.array([0.5, 0.5], np.float32))
    b = BowVector(np.array([3], np.int32), np.array([1.0], np.float32))
    ids, scores = index_of([a, b]).query(b, 10)
    assert ids.tolist() == [1]
    assert len(scores) == 1


def test_words_out_of_range_are_ignored() -> None:
    vectors = random_vectors(4)
    wild = BowVector(np.array([-5, N_WORDS, 1 << 30], np.int32), np.full(3, 0.3, np.float32))
    assert index_of(vectors).scores(wild).max() == 0.0


def test_an_image_without_features_is_like_nothing() -> None:
    empty = shipped_vocabulary().describe(np.empty((0, 32), np.uint8))
    assert len(empty.words) == 0
    assert index_of(random_vectors(3)).query(empty, 5)[0].size == 0


def test_the_shipped_vocabulary_is_small_and_has_thousands_of_words() -> None:
    vocabulary = shipped_vocabulary()
    assert SHIPPED.stat().st_size < 1_000_000
    assert 5_000 < vocabulary.n_words <= 10_000
    assert "simulated" in vocabulary.metadata["origin"]


def test_quantising_goes_to_the_nearest_child() -> None:
    vocabulary = shipped_vocabulary()
    arrays = tile_format.decode(memoryview(SHIPPED.read_bytes()), "vocabulary")[0]
    descriptors = some_descriptors(50)
    expected = []
    for descriptor in descriptors:
        node = 0
        while count := int(arrays["n_children"][node]):
            first = int(arrays["first_child"][node])
            children = arrays["nodes"][first : first + count]
            bits = np.unpackbits(children ^ descriptor, axis=1).sum(axis=1)
            node = first + int(np.argmin(bits))
        expected.append(int(arrays["word"][node]))
    assert vocabulary.quantise(descriptors).tolist() == expected


def test_a_descriptor_keeps_its_word_with_a_few_bits_of_noise_more_often_than_not() -> None:
    vocabulary = shipped_vocabulary()
    arrays = tile_format.decode(memoryview(SHIPPED.read_bytes()), "vocabulary")[0]
    leaves = arrays["nodes"][arrays["n_children"] == 0]
    noise = np.zeros((len(leaves), 256), np.uint8)
    noise[:, np.random.default_rng(1).permutation(256)[:5]] = 1
    noisy = leaves ^ np.packbits(noise, axis=1)
    assert np.mean(vocabulary.quantise(leaves) == vocabulary.quantise(noisy)) > 0.7


def test_weights_of_an_image_sum_to_one_and_rare_words_weigh_more() -> None:
    vocabulary = shipped_vocabulary()
    common, rare = int(np.argmin(vocabulary.idf)), int(np.argmax(vocabulary.idf))
    vector = vocabulary.vector(np.array([common, rare, rare, common], np.int32))
    assert vector.weights.sum() == pytest.approx(1.0)
    assert vector.words.tolist() == sorted({common, rare})
    by_word = dict(zip(vector.words.tolist(), vector.weights.tolist(), strict=True))
    assert by_word[rare] > by_word[common]


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("first_child", lambda a: np.zeros_like(a)),  # round and round for ever
        ("first_child", lambda a: a + np.int32(1_000_000)),
        ("n_children", lambda a: np.full_like(a, 255)),
        ("word", lambda a: a + np.int32(1_000_000)),
        ("word", lambda a: a[:-1]),
        ("nodes", lambda a: a[:, :16].copy()),
        ("nodes", lambda a: a.astype(np.int16)),
        ("idf", lambda a: a * np.float32(np.nan)),
        ("idf", None),
    ],
)
def test_a_damaged_vocabulary_is_refused(name: str, spoil: object) -> None:
    arrays = tile_format.decode(memoryview(SHIPPED.read_bytes()), "vocabulary")[0]
    if spoil is None:
        del arrays[name]
    else:
        arrays[name] = spoil(arrays[name])  # type: ignore[operator]
    with pytest.raises(TileError, match=r"words\.tile"):
        Vocabulary(tile_format.encode(arrays), "words.tile")
