# SPDX-License-Identifier: Apache-2.0
import math

import msgspec
import numpy as np
import pytest

from edge.config.relocalise import RelocaliseConfig
from edge.geometry import se3
from edge.relocalise.scale import log_scale
from edge.types import DepthSamples
from tests.edge.relocalise.pools import pool_of
from tests.edge.relocalise.room_matches import CAMERA

CONFIG = RelocaliseConfig()
TRUE_SCALE = 0.43  # metres per odometry unit


def scene(n: int = 200, hidden_share: float = 0.0, seed: int = 0):
    """Points in view and samples at their pixels; hidden points lie behind what is seen."""
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=6))
    pixels = rng.uniform((20, 20), (620, 460), (n, 2))
    depth = rng.uniform(1.0, 4.0, n)
    hidden = rng.random(n) < hidden_share
    map_depth = np.where(hidden, depth * rng.uniform(1.1, 2.0, n), depth)
    rays = (pixels - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx
    xyz = se3.transform(T, np.column_stack((rays * map_depth[:, None], map_depth)))
    pool = pool_of(xyz, np.tile(1e-4 * np.eye(3), (n, 1, 1)), T)
    inverse = TRUE_SCALE / depth * np.exp(0.01 * rng.normal(size=n))
    samples = DepthSamples(
        (pixels + rng.uniform(-1, 1, (n, 2))).astype(np.float32),
        inverse.astype(np.float32),
        (0.01 * inverse).astype(np.float32),
    )
    return pool, T, samples


@pytest.mark.parametrize("hidden_share", [0.0, 0.3])
def test_scale_is_true_also_where_points_are_hidden(hidden_share: float) -> None:
    pool, T, samples = scene(hidden_share=hidden_share)
    told = log_scale(pool, T, CAMERA, samples, CONFIG)
    assert told is not None
    assert told[0] == pytest.approx(math.log(TRUE_SCALE), abs=0.006)
    assert told[1] >= CONFIG.scale_common


def test_the_plain_mean_is_dragged_away_by_hidden_points() -> None:
    config = msgspec.structs.replace(CONFIG, scale_mean_ratio=True)
    pool, T, samples = scene()
    told = log_scale(pool, T, CAMERA, samples, config)
    assert told is not None
    assert told[0] == pytest.approx(math.log(TRUE_SCALE), abs=0.01)
    pool, T, samples = scene(hidden_share=0.3)
    dragged = log_scale(pool, T, CAMERA, samples, config)
    assert dragged is not None
    assert dragged[0] > math.log(TRUE_SCALE) + 0.05


def test_depths_that_know_little_make_a_scale_that_knows_little() -> None:
    pool, T, samples = scene()
    vague = DepthSamples(samples.pixels, samples.inverse_depth, 6.0 * samples.sigma)
    sure, unsure = (log_scale(pool, T, CAMERA, s, CONFIG) for s in (samples, vague))
    assert sure is not None
    assert unsure is not None
    assert unsure[1] > 2.0 * sure[1]


def test_too_few_common_places_tell_nothing() -> None:
    pool, T, samples = scene(n=8)
    assert log_scale(pool, T, CAMERA, samples, CONFIG) is None
    pool, T, samples = scene()
    elsewhere = DepthSamples(samples.pixels + 2000.0, samples.inverse_depth, samples.sigma)
    assert log_scale(pool, T, CAMERA, elsewhere, CONFIG) is None
    none = np.zeros(0, np.float32)
    empty = DepthSamples(none.reshape(0, 2), none, none)
    assert log_scale(pool, T, CAMERA, empty, CONFIG) is None


def test_depths_without_value_are_left_out() -> None:
    pool, T, samples = scene()
    inverse, sigma = samples.inverse_depth.copy(), samples.sigma.copy()
    inverse[::2] = 0.0
    sigma[1::4] = np.inf
    told = log_scale(pool, T, CAMERA, DepthSamples(samples.pixels, inverse, sigma), CONFIG)
    assert told is not None
    assert told[0] == pytest.approx(math.log(TRUE_SCALE), abs=0.01)


def test_uncertain_map_points_count_less() -> None:
    errors = []
    for seed in range(8):
        pool, T, samples = scene(n=400, seed=seed)
        rng = np.random.default_rng(seed)
        vague = rng.random(400) < 0.9
        stretch = np.where(vague, np.exp(0.09 * rng.normal(size=400)), 1.0)
        xyz = T[:3, 3] + stretch[:, None] * (pool.xyz - T[:3, 3])
        depth = (pool.xyz - T[:3, 3]) @ T[:3, 2]
        C = pool.C * np.where(vague, (0.09 * depth / 0.01) ** 2, 1e-2)[:, None]
        told = log_scale(pool._replace(xyz=xyz, C=C), T, CAMERA, samples, CONFIG)
        assert told is not None
        errors.append(told[0] - math.log(TRUE_SCALE))
    # Weighed alike they would give 0.0125.
    assert np.sqrt(np.mean(np.square(errors))) < 0.008
