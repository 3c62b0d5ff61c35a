# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.relocalise.bow import Vocabulary
from maps.vocabulary_training import train

RNG = np.random.default_rng(0)
CENTRES = RNG.integers(0, 256, (12, 32)).astype(np.uint8)


def noisy(centres: np.ndarray, copies: int, bits: int, seed: int = 0) -> np.ndarray:
    """Copies of each centre with some bits flipped."""
    rng = np.random.default_rng(seed)
    made = np.repeat(centres, copies, axis=0)
    flips = rng.permuted(np.tile(np.arange(256) < bits, (len(made), 1)), axis=1)
    return made ^ np.packbits(flips, axis=1)


def trained(seed: int = 0, **settings: int) -> bytes:
    descriptors = noisy(CENTRES, 60, 12)
    images = np.arange(len(descriptors), dtype=np.int32) % 20
    return train(descriptors, images, seed=seed, **settings)


def test_clusters_are_found_and_the_word_of_a_descriptor_is_its_clusters() -> None:
    vocabulary = Vocabulary(trained(branching=12, depth=1), "new")
    assert vocabulary.n_words >= 11  # two starts may fall into one cluster, and one dies out
    words = vocabulary.quantise(noisy(CENTRES, 5, 20, seed=1)).reshape(12, 5)
    assert (words == words[:, :1]).all()
    assert len(set(words[:, 0].tolist())) >= 11


def test_the_same_seed_gives_the_same_bytes() -> None:
    assert trained(3, branching=4, depth=3) == trained(3, branching=4, depth=3)
    assert trained(3, branching=4, depth=3) != trained(4, branching=4, depth=3)


@pytest.mark.parametrize(("branching", "depth"), [(3, 2), (5, 3), (10, 4)])
def test_there_are_at_most_branching_to_the_depth_words(branching: int, depth: int) -> None:
    vocabulary = Vocabulary(trained(branching=branching, depth=depth), "new")
    assert branching <= vocabulary.n_words <= branching**depth


def test_rare_words_weigh_more() -> None:
    # Each image shows the first centre; the second is in one image of twenty.
    descriptors = np.concatenate([noisy(CENTRES[:1], 60, 4), noisy(CENTRES[1:2], 60, 4)])
    images = np.concatenate([np.arange(60) % 20, np.zeros(60)]).astype(np.int32)
    vocabulary = Vocabulary(train(descriptors, images, branching=2, depth=1), "new")
    common, rare = vocabulary.quantise(CENTRES[:2])
    assert vocabulary.idf[common] == pytest.approx(np.log(21 / 20))
    assert vocabulary.idf[rare] == pytest.approx(np.log(21 / 1))


def test_descriptors_that_are_all_alike_are_one_word() -> None:
    alike = np.tile(CENTRES[:1], (100, 1))
    vocabulary = Vocabulary(train(alike, np.zeros(100, np.int32), branching=4, depth=3), "new")
    assert vocabulary.n_words == 1
    assert vocabulary.quantise(CENTRES).tolist() == [0] * 12
