# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.config.relocalise import RelocaliseConfig
from edge.geometry import se3, so3
from edge.relocalise.pool import Pool, unpacked
from edge.relocalise.projection import View, project
from tests.edge.relocalise.pools import SCALE_FACTOR, pool_of
from tests.edge.relocalise.room_matches import CAMERA, LENS

CONFIG = RelocaliseConfig()
WIDE = (1.0, 1e6)


@pytest.fixture
def scene() -> tuple[Pool, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    T = se3.exp(rng.normal(size=6))
    pixels = rng.uniform((100, 100), (540, 380), (50, 2))
    depth = rng.uniform(1, 4, 50)
    rays = (pixels - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx
    xyz = se3.transform(T, np.column_stack((rays * depth[:, None], depth)))
    L = 0.01 * rng.normal(size=(50, 3, 3))
    return pool_of(xyz, L @ L.transpose(0, 2, 1), T), T, pixels


def test_points_project_where_they_are_seen(scene) -> None:
    pool, T, pixels = scene
    projection = project(pool, View(T, None, LENS), SCALE_FACTOR, CONFIG, WIDE)
    np.testing.assert_allclose(projection.centre, pixels, atol=1e-6)
    np.testing.assert_allclose(projection.level, 0.0, atol=1e-5)
    assert np.all(projection.radius_px > 0.0)


def test_sigma_is_that_of_many_throws(scene) -> None:
    pool, T, _ = scene
    rng = np.random.default_rng(1)
    # Correlated as a pose is: aside and turned back leave the picture almost as it was.
    root = rng.normal(size=(6, 6)) * np.repeat((0.02, 0.01), 3)[:, None]
    covariance = root @ root.T
    projection = project(pool, View(T, covariance, LENS), SCALE_FACTOR, CONFIG, WIDE)
    roots = np.linalg.cholesky(unpacked(pool.C) + 1e-18 * np.eye(3))
    thrown = []
    for _ in range(600):
        v, w = np.split(root @ rng.normal(size=6), 2)
        T_thrown = se3.from_rotation_translation(so3.exp(w) @ T[:3, :3], T[:3, 3] + v)
        xyz = pool.xyz + np.einsum("nij,nj->ni", roots, rng.normal(size=(50, 3)))
        view = View(T_thrown, None, LENS)
        thrown.append(project(pool._replace(xyz=xyz), view, SCALE_FACTOR, CONFIG, WIDE).centre)
    for i in range(50):
        largest = np.sqrt(np.linalg.eigvalsh(np.cov(np.array(thrown)[:, i].T))[-1])
        assert projection.sigma_px[i] == pytest.approx(largest, rel=0.15)


def test_points_behind_outside_or_seen_from_elsewhere_are_left_out(scene) -> None:
    pool, T, _ = scene
    behind = T @ se3.exp([0, 0, 0, 0, np.pi, 0])
    assert not project(pool, View(behind, None, LENS), SCALE_FACTOR, CONFIG, WIDE).radius_px.any()
    beside = pool._replace(ray=-pool.ray)
    assert not project(beside, View(T, None, LENS), SCALE_FACTOR, CONFIG, WIDE).radius_px.any()


def test_a_window_that_would_be_too_large_is_none(scene) -> None:
    pool, T, _ = scene
    covariance = np.diag(np.repeat((0.02**2, 0.01**2), 3))
    view = View(T, covariance, LENS)
    assert not project(pool, view, SCALE_FACTOR, CONFIG, (4.0, 8.0)).radius_px.any()
    narrow = project(pool, View(T, None, LENS), SCALE_FACTOR, CONFIG, (4.0, 24.0))
    assert np.all(narrow.radius_px[narrow.radius_px > 0] >= 4.0)


def test_a_point_twice_as_far_appears_on_a_lower_octave(scene) -> None:
    pool, T, _ = scene
    closer = T.copy()
    far = pool._replace(pixel_m=2.0 * pool.pixel_m)  # it was seen from twice as far
    level = project(far, View(closer, None, LENS), SCALE_FACTOR, CONFIG, WIDE).level
    np.testing.assert_allclose(level, np.log(2.0) / np.log(SCALE_FACTOR), rtol=1e-5)
