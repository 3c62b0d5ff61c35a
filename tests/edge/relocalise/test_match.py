# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.geometry import se3
from edge.relocalise.features import Features
from edge.relocalise.match import match_all, match_near, most_promising
from edge.relocalise.pool import Pool
from edge.relocalise.projection import View, project
from tests.edge.relocalise.pools import SCALE_FACTOR, pool_of
from tests.edge.relocalise.room_matches import CAMERA, LENS

CONFIG = RelocaliseConfig()


def scene(n: int = 40, flipped_bits: int = 10, seed: int = 0) -> tuple[Features, Pool, np.ndarray]:
    """n features, each of them one point; the map knows them by nearly the same descriptors."""
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=6))
    pixels = rng.uniform((40, 40), (600, 440), (n, 2))
    depth = rng.uniform(1, 4, n)
    rays = (pixels - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx
    xyz = se3.transform(T, np.column_stack((rays * depth[:, None], depth)))
    pool = pool_of(xyz, np.tile(1e-6 * np.eye(3), (n, 1, 1)), T)
    bits = rng.integers(0, 2, (n, 256), dtype=np.uint8)
    seen = bits.copy()
    for row in seen:
        row[rng.permutation(256)[:flipped_bits]] ^= 1
    features = Features(
        pixels.astype(np.float32),
        np.packbits(seen, axis=1),
        np.zeros(n, np.uint8),
        np.zeros(n, np.float32),
        pixels.astype(np.float32),
    )
    pool = pool._replace(descriptors=np.packbits(bits, axis=1).view(np.uint64))
    return features, pool, T


def doubled(pool: Pool, which: int, xyz: np.ndarray) -> Pool:
    """The pool with one more point at `xyz` that looks exactly like point `which`."""
    more = {
        name: np.concatenate((column, column[which : which + 1]))
        for name, column in pool._asdict().items()
        if name != "keyframes"
    }
    more["point"][-1] = len(pool.xyz)
    more["xyz"][-1] = xyz
    return Pool(pool.keyframes, **more)


def test_every_feature_finds_its_point() -> None:
    features, pool, _ = scene()
    found = match_all(features, pool, CONFIG)
    assert found.feature.tolist() == found.row.tolist() == list(range(40))
    assert np.all(found.distance == 10)


def test_unlike_descriptors_do_not_match() -> None:
    features, pool, _ = scene(flipped_bits=90)
    assert len(match_all(features, pool, CONFIG).feature) == 0


def test_a_twin_elsewhere_makes_a_match_doubtful_and_drops_it() -> None:
    features, pool, _ = scene()
    twin = doubled(pool, 7, pool.xyz[7] + 0.5)
    assert 7 not in match_all(features, twin, CONFIG).feature


def test_a_twin_at_the_same_place_is_the_same_point() -> None:
    features, pool, _ = scene()
    twin = doubled(pool, 7, pool.xyz[7] + 0.001)
    assert 7 in match_all(features, twin, CONFIG).feature


def test_of_twins_at_one_place_the_more_certain_is_taken() -> None:
    features, pool, _ = scene()
    C = pool.C.copy()
    C[7] *= 100.0
    twin = doubled(pool._replace(C=C), 7, pool.xyz[7])
    twin.C[-1] = pool.C[7]
    found = match_all(features, twin, CONFIG)
    assert found.row[found.feature == 7].tolist() == [40]


def test_of_two_features_for_one_point_only_the_nearer_stays() -> None:
    features, pool, _ = scene()
    copy = features.descriptors.copy()
    copy[3] = pool.descriptors.view(np.uint8).reshape(-1, 32)[5]  # feature 3 now looks like point 5
    found = match_all(features._replace(descriptors=copy), pool, CONFIG)
    assert found.feature[found.row == 5].tolist() == [3]


def test_a_point_that_rather_shows_another_feature_is_not_matched() -> None:
    features, pool, _ = scene(flipped_bits=20)
    bytes_of = pool.descriptors.view(np.uint8).reshape(-1, 32).copy()
    copy = features.descriptors.copy()
    # Feature 3 is 5 bits from point 5, but only 2 bits from point 8: it goes to point 8.
    bytes_of[8] = bytes_of[5]
    bytes_of[8, 0] ^= 0b01111111
    copy[3] = bytes_of[5]
    copy[3, 0] ^= 0b00011111
    found = match_all(
        features._replace(descriptors=copy),
        pool._replace(descriptors=bytes_of.view(np.uint64)),
        RelocaliseConfig(max_ratio=1.0),
    )
    assert found.row[found.feature == 3].tolist() == [8]
    assert 5 not in found.feature


def test_matches_that_turn_otherwise_are_dropped() -> None:
    features, pool, _ = scene()
    angle = np.full(40, 0.5, np.float32)
    angle[[4, 9]] = 2.5
    found = match_all(features._replace(angle_rad=angle), pool, CONFIG)
    assert set(range(40)) - set(found.feature.tolist()) == {4, 9}


def test_projections_find_their_features_and_no_others() -> None:
    features, pool, T = scene(flipped_bits=50)
    projection = project(pool, View(T, None, LENS), SCALE_FACTOR, CONFIG, (5.0, 24.0))
    found = match_near(features, pool, projection, CAMERA, CONFIG)
    assert found.feature.tolist() == found.row.tolist() == list(range(40))
    beside = projection._replace(centre=projection.centre + np.array((30.0, 0.0)))
    assert len(match_near(features, pool, beside, CAMERA, CONFIG).feature) <= 1


def test_uncertain_points_are_not_sampled() -> None:
    features, pool, _ = scene()
    C = pool.C.copy()
    C[:15, (0, 3, 5)] = 1.0
    found = match_all(features, pool._replace(C=C), CONFIG)
    promising = most_promising(found, pool._replace(C=C))
    assert sorted(promising.tolist()) == list(range(15, 40))


def test_nothing_to_match_gives_no_matches() -> None:
    features, pool, T = scene()
    none = Features(*(column[:0] for column in features))
    assert len(match_all(none, pool, CONFIG).feature) == 0
    projection = project(pool, View(T, None, LENS), SCALE_FACTOR, CONFIG, (5.0, 24.0))
    assert len(match_near(none, pool, projection, CAMERA, CONFIG).feature) == 0
