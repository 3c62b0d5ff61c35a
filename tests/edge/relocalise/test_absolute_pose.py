# SPDX-License-Identifier: Apache-2.0
import msgspec
import numpy as np
import pytest

from edge.config.relocalise import RelocaliseConfig
from edge.geometry import se3
from edge.geometry.covariance import position_sigma
from edge.relocalise import absolute_pose
from edge.relocalise.assessment import Solution
from tests.edge.relocalise.room_matches import CAMERA, error, room_matches

CONFIG = RelocaliseConfig()


def found(seed: int, **options: float) -> tuple[Solution, np.ndarray]:
    room = room_matches(seed, **options)
    order = np.random.default_rng(seed).permutation(len(room.wrong)).astype(np.int32)
    searched = absolute_pose.search(room.matches, order, CAMERA, seed, CONFIG)
    assert searched is not None
    solution = absolute_pose.solve_from(searched[0], room.matches, CAMERA, CONFIG)
    assert solution is not None
    return solution, room.T_map_cam


@pytest.mark.parametrize("wrong_share", [0.0, 0.4, 0.7])
def test_pose_is_found_among_wrong_matches(wrong_share: float) -> None:
    for seed in range(10):
        solution, T_true = found(seed, wrong_share=wrong_share, sigma_along_m=0.02)
        assert np.linalg.norm(error(solution.T_map_cam, T_true)[:3]) < 0.02


def test_inliers_are_the_right_matches() -> None:
    room = room_matches(3, wrong_share=0.5)
    solution, _ = found(3, wrong_share=0.5)
    assert np.mean(solution.inlier[~room.wrong]) > 0.9
    assert np.mean(solution.inlier[room.wrong]) < 0.05


def test_noise_alone_explains_little() -> None:
    room = room_matches(4, wrong_share=1.0)
    right = room_matches(4)
    order = np.arange(200, dtype=np.int32)
    noise = absolute_pose.search(room.matches, order, CAMERA, 1, CONFIG)
    truth = absolute_pose.search(right.matches, order, CAMERA, 1, CONFIG)
    assert truth is not None
    assert noise is None or noise[1] < 0.1 * truth[1]


def test_search_is_the_same_each_time_and_for_any_start_of_the_seed() -> None:
    room = room_matches(5, wrong_share=0.5)
    order = np.arange(200, dtype=np.int32)
    first = absolute_pose.search(room.matches, order, CAMERA, 7, CONFIG)
    second = absolute_pose.search(room.matches, order, CAMERA, 7, CONFIG)
    assert first is not None
    assert second is not None
    assert np.array_equal(first[0], second[0])
    assert absolute_pose.search(room.matches, order, CAMERA, 0, CONFIG) is not None


def test_too_few_matches_give_no_pose() -> None:
    room = room_matches(6, n=3)
    assert (
        absolute_pose.search(room.matches, np.arange(3, dtype=np.int32), CAMERA, 1, CONFIG) is None
    )
    assert absolute_pose.solve_from(room.T_map_cam, room.matches, CAMERA, CONFIG) is None


def test_covariance_covers_the_error_with_independent_noise() -> None:
    """Common errors are foreseen that are not there: modest, but not by much."""
    nees = []
    for seed in range(40):
        solution, T_true = found(seed, wrong_share=0.3, sigma_along_m=0.03)
        e = error(solution.T_map_cam, T_true)
        nees.append(e @ np.linalg.solve(solution.covariance, e) / 6.0)
    assert 0.1 < np.mean(nees) < 1.2


def test_errors_that_a_whole_area_shares_are_covered() -> None:
    """As along map edges: all points of a place are off along their rays together."""
    nees = []
    for seed in range(80):
        room = room_matches(seed, sigma_along_m=0.06)
        shift = 0.5 * np.random.default_rng(seed).normal()
        exact = room_matches(seed, sigma_along_m=0.0).matches.xyz
        matches = room.matches._replace(xyz=exact + shift * room.matches.axis)
        solution = absolute_pose.solve_from(room.T_map_cam, matches, CAMERA, CONFIG)
        assert solution is not None
        e = error(solution.T_map_cam, room.T_map_cam)
        nees.append(e @ np.linalg.solve(solution.covariance, e) / 6.0)
    assert np.mean(nees) < 2.2  # without this foresight it is 3.7


def test_what_the_whole_image_errs_by_is_no_more_than_its_cells_show() -> None:
    """Exact matches leave a smaller floor than those whose cells are off together."""
    floor = {}
    for common_px in (0.1, 4.0):
        covariance = []
        for floor_share in (0.0, CONFIG.floor_share):
            config = msgspec.structs.replace(CONFIG, common_px=common_px, floor_share=floor_share)
            room = room_matches(3)
            solution = absolute_pose.solve_from(room.T_map_cam, room.matches, CAMERA, config)
            assert solution is not None
            covariance.append(solution.covariance)
        floor[common_px] = (covariance[1] - covariance[0])[3, 3] ** 0.5
    assert floor[4.0] == pytest.approx(CONFIG.floor_share, rel=1e-3)
    assert floor[0.1] < 0.8 * CONFIG.floor_share


def test_a_corner_is_less_certain_than_the_whole_image() -> None:
    wide, _ = found(8)
    narrow, _ = found(8, window_px=(20.0, 20.0, 120.0, 80.0))
    assert narrow.spread < 0.05 < wide.spread
    assert narrow.cells < wide.cells
    assert position_sigma(narrow.covariance) > 3.0 * position_sigma(wide.covariance)


def test_unexplained_matches_are_the_wrong_ones() -> None:
    room = room_matches(9, wrong_share=0.3)
    left = absolute_pose.unexplained(room.matches, room.T_map_cam, CAMERA, CONFIG)
    assert np.mean(left[room.wrong]) > 0.8
    assert not np.any(left[~room.wrong])


def test_a_second_place_is_found_among_what_the_first_leaves() -> None:
    a, b = room_matches(10), room_matches(11, n=80)
    both = absolute_pose.Correspondences(
        *(np.concatenate((x, y)) for x, y in zip(a.matches, b.matches, strict=True))
    )
    left = absolute_pose.unexplained(both, a.T_map_cam, CAMERA, CONFIG)
    rest = absolute_pose.Correspondences(*(column[left] for column in both))
    searched = absolute_pose.search(
        rest, np.arange(len(rest.pixels), dtype=np.int32), CAMERA, 1, CONFIG
    )
    assert searched is not None
    assert np.linalg.norm(se3.log(se3.inverse(b.T_map_cam) @ searched[0])) < 0.05
