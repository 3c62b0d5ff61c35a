# SPDX-License-Identifier: Apache-2.0
import numpy as np

from maps.matching import Matches
from maps.tracks import Tracks, join


def matches(*pairs: tuple[int, int], bits: int = 10) -> Matches:
    first, second = np.array(pairs, np.int32).reshape(-1, 2).T
    return Matches(first, second, np.full(len(first), bits, np.int32))


def joined(counts: list[int], *pairs: tuple[int, int, Matches], depth: bool = False) -> Tracks:
    return join(counts, pairs, [np.full(count, depth) for count in counts])


def as_sets(tracks: Tracks) -> list[set[tuple[int, int]]]:
    return [
        {(int(tracks.view[row]), int(tracks.feature[row])) for row in range(a, b)}
        for a, b in zip(tracks.offsets, tracks.offsets[1:], strict=False)
    ]


def test_matches_chain_over_views() -> None:
    tracks = joined([3, 3, 3], (0, 1, matches((0, 2), (1, 1))), (1, 2, matches((2, 0))))
    assert as_sets(tracks) == [{(0, 0), (1, 2), (2, 0)}, {(0, 1), (1, 1)}]


def test_no_track_holds_two_features_of_one_image_and_the_surer_match_wins() -> None:
    sure = (0, 1, matches((0, 0), bits=5))
    closing = (1, 2, matches((0, 0), bits=6))
    clash = (0, 2, matches((1, 0), bits=40))
    for order in ((sure, closing, clash), (clash, closing, sure)):
        tracks = joined([2, 1, 1], *order)
        assert as_sets(tracks) == [{(0, 0), (1, 0), (2, 0)}]


def test_every_track_of_random_matches_is_consistent_and_nothing_is_twice() -> None:
    rng = np.random.default_rng(0)
    pairs = []
    for i in range(8):
        for j in range(i + 1, 8):
            found = zip(rng.permutation(40)[:20], rng.permutation(40)[:20], strict=True)
            pairs.append((i, j, matches(*found, bits=int(rng.integers(0, 60)))))
    tracks = joined([40] * 8, *pairs)
    members = [member for track in as_sets(tracks) for member in track]
    assert len(members) == len(set(members)) == len(tracks.view)
    for track in as_sets(tracks):
        assert len({view for view, _ in track}) == len(track) >= 2


def test_observations_of_a_track_come_in_the_order_of_the_views() -> None:
    tracks = joined([1, 1, 1], (1, 2, matches((0, 0))), (0, 2, matches((0, 0))))
    assert tracks.view.tolist() == [0, 1, 2]


def test_a_feature_with_a_depth_is_a_track_alone() -> None:
    tracks = join([2, 1], [], [np.array([True, False]), np.array([True])])
    assert as_sets(tracks) == [{(0, 0)}, {(1, 0)}]


def test_without_matches_there_are_no_tracks() -> None:
    assert as_sets(joined([3, 3])) == []
