# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.config.relocalise import RelocaliseConfig
from edge.relocalise.absolute_pose import solve_from
from edge.relocalise.assessment import Solution
from edge.relocalise.correspondences import Correspondences
from edge.relocalise.stability import stability
from tests.edge.relocalise.room_matches import CAMERA, room_matches

CONFIG = RelocaliseConfig()


def test_without_wrong_parts_the_spread_is_that_of_noise() -> None:
    squares = []
    for seed in range(30):
        room = room_matches(seed)
        found = solve_from(room.T_map_cam, room.matches, CAMERA, CONFIG)
        assert found is not None
        parts = stability(found.T_map_cam, room.matches, found.inlier.astype(float), CAMERA, CONFIG)
        off = found.T_map_cam[:3, 3] - room.T_map_cam[:3, 3]
        squares.append(off @ np.linalg.solve(parts.covariance[:3, :3], off) / 3.0)
    assert 0.3 < np.mean(squares) < 4.0


def test_a_part_that_is_wrong_in_itself_widens_the_covariance() -> None:
    grown = []
    for seed in range(20):
        room = room_matches(seed)
        spoilt = with_corner_moved(room.matches, 0.02)
        rough = solve_from(room.T_map_cam, spoilt, CAMERA, CONFIG)
        found = solve_from(room.T_map_cam, spoilt, CAMERA, CONFIG, coarse=False)
        assert rough is not None
        assert found is not None
        grown.append(largest_sigma(found) / largest_sigma(rough))
    assert np.mean(grown) > 1.3


def test_matches_beyond_the_gate_that_point_elsewhere_together_widen_the_covariance() -> None:
    room = room_matches(3)
    sigmas = []
    for moved_px in (0.0, 12.0):
        aside = np.where(np.arange(200) % 4 == 0, moved_px, 0.0)
        spoilt = room.matches._replace(
            pixels=room.matches.pixels + np.column_stack((aside, np.zeros(200)))
        )
        inlier = (aside == 0.0).astype(float)  # in every part of the image
        parts = stability(room.T_map_cam, spoilt, inlier, CAMERA, CONFIG)
        sigmas.append(np.sqrt(np.trace(parts.covariance[:3, :3])))
    assert sigmas[1] > 1.4 * sigmas[0]


# The first three gave a singular matrix.
@pytest.mark.parametrize("seed", [1927, 2833, 3654, *range(20)])
def test_matches_that_hardly_tell_a_pose_do_no_harm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, places = int(rng.integers(4, 40)), int(rng.integers(1, 4))
    # Many matches, but of one to three points in space.
    apart = rng.normal(size=(places, 3)) * rng.choice([0.0, 0.1, 1.0])
    xyz = (np.array((0.0, 0.0, 5.0)) + apart)[rng.integers(0, places, n)]
    xyz += 10.0 ** rng.uniform(-14, -3) * rng.normal(size=(n, 3))
    exact = xyz[:, :2] / xyz[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
    pixels = exact + rng.normal(size=(n, 2)) * 0.5
    few = Correspondences(*(field[:n] for field in room_matches(0).matches))
    few = few._replace(pixels=pixels, xyz=xyz)
    parts = stability(np.eye(4), few, np.ones(n), CAMERA, CONFIG)
    assert np.all(np.isfinite(parts.covariance))


def largest_sigma(found: Solution) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1]))


def with_corner_moved(matches: Correspondences, shift_m: float) -> Correspondences:
    """The points of the image's left border, all moved alike."""
    corner = matches.pixels[:, 0] < CAMERA.width / 4
    xyz = matches.xyz.copy()
    xyz[corner] += (shift_m, 0.0, 0.0)
    return matches._replace(xyz=xyz)


@pytest.mark.parametrize("seed", range(4))
def test_few_exact_and_wrong_matches_do_not_drag_a_good_pose_away(seed: int) -> None:
    room = room_matches(seed, n=40, sigma_along_m=0.2)
    xyz, C = room.matches.xyz.copy(), room.matches.C.copy()
    near = np.argsort(np.linalg.norm(xyz - room.T_map_cam[:3, 3], axis=1))[:4]
    xyz[near] += (0.1, 0.05, 0.0)
    C[near] = 1e-8 * np.array((1.0, 0.0, 0.0, 1.0, 0.0, 1.0))
    found = solve_from(room.T_map_cam, room.matches._replace(xyz=xyz, C=C), CAMERA, CONFIG)
    assert found is not None
    assert not found.inlier[near].any()
    assert np.linalg.norm(found.T_map_cam[:3, 3] - room.T_map_cam[:3, 3]) < 0.07
