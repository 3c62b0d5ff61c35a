# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.config.relocalise import RelocaliseConfig
from edge.relocalise.assessment import Solution
from edge.relocalise.gates import Fitting, Seen, seen_from, visible_share, why_not
from tests.edge.relocalise.room_matches import CAMERA

CONFIG = RelocaliseConfig()
SEEN = Seen(0.4, 0.9, 0.9)


def solution(**changes: object) -> Solution:
    good = Solution(
        np.eye(4),
        np.diag(np.repeat((0.005**2, 0.003**2), 3)),
        np.ones(80, bool),
        300.0,
        1.0,
        20,
        0.2,
        2.0,
    )
    return good._replace(**changes)


def test_a_good_solution_passes() -> None:
    assert why_not(solution(), SEEN, CONFIG) == "ok"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"inlier": np.arange(80) < 10}, "few inliers"),
        ({"cells": 3}, "inliers in a corner of the image"),
        ({"spread": 0.03}, "inliers in a corner of the image"),
        ({"covariance": np.diag(np.repeat((0.05**2, 0.003**2), 3))}, "position uncertain"),
        ({"covariance": np.diag(np.repeat((0.005**2, 0.04**2), 3))}, "rotation uncertain"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_reasons(changes: dict[str, object], reason: str) -> None:
    assert why_not(solution(**changes), SEEN, CONFIG) == reason


def test_what_was_foretold_may_be_less_certain() -> None:
    uncertain = solution(covariance=np.diag(np.repeat((0.05**2, 0.003**2), 3)), spread=0.03)
    assert why_not(uncertain, SEEN, CONFIG, foretold=True) == "ok"
    lost = solution(covariance=np.diag(np.repeat((0.2**2, 0.003**2), 3)))
    assert why_not(lost, SEEN, CONFIG, foretold=True) == "position uncertain"
    few = solution(inlier=np.arange(80) < 10)
    assert why_not(few, SEEN, CONFIG, foretold=True) == "few inliers"


def test_many_inliers_do_not_excuse_what_is_not_seen() -> None:
    many = solution(inlier=np.ones(500, bool), cells=40)
    assert why_not(many, Seen(0.1, 0.3, 0.9), CONFIG) == "little of what should be seen is seen"


def test_covariance_is_judged_by_the_size_of_the_scene() -> None:
    """A map without metres: everything ten times as large is the same."""
    covariance = np.diag(np.repeat((0.1**2, 0.003**2), 3))
    assert why_not(solution(covariance=covariance), SEEN, CONFIG) == "position uncertain"
    assert why_not(solution(covariance=covariance, depth_m=20.0), SEEN, CONFIG) == "ok"


def fitting(pixels: np.ndarray, chance: float, visible: float = 1.0) -> Fitting:
    return Fitting(pixels, np.ones(len(pixels), bool), chance, visible)


def test_a_poster_among_an_unseen_room_is_weak_evidence() -> None:
    rng = np.random.default_rng(0)
    expected = rng.uniform((0, 0), (640, 480), (1500, 2))
    everywhere = expected[rng.random(1500) < 0.3].astype(np.float32)
    on_poster = expected[(expected[:, 0] < 160) & (expected[:, 1] < 160)].astype(np.float32)
    room = seen_from(expected, fitting(everywhere, 0.02), CAMERA, CONFIG)
    poster = seen_from(expected, fitting(on_poster, 0.02), CAMERA, CONFIG)
    assert room.evidence > CONFIG.min_evidence > poster.evidence


def test_matches_by_chance_are_no_evidence() -> None:
    rng = np.random.default_rng(1)
    expected = rng.uniform((0, 0), (640, 480), (3000, 2))
    by_chance = expected[rng.random(3000) < 0.05].astype(np.float32)
    seen = seen_from(expected, fitting(by_chance, 0.1), CAMERA, CONFIG)
    assert seen.cells < 0.3


def test_no_expectation_is_no_evidence() -> None:
    nothing = fitting(np.zeros((0, 2), np.float32), 0.0)
    none = seen_from(np.zeros((0, 2)), nothing, CAMERA, CONFIG)
    assert none.evidence == 0.0


def test_a_blurred_image_need_not_show_fine_points() -> None:
    level = np.repeat(np.arange(8), 50).astype(np.float32)
    sharp = np.repeat(np.arange(8), 100).astype(np.uint8)
    blurred = sharp[sharp >= 5]
    assert visible_share(level, sharp) == 1.0
    assert visible_share(level, blurred) == pytest.approx(0.5)  # from the octave before them
    assert visible_share(level, blurred[:0]) == pytest.approx(0.1)
    rng = np.random.default_rng(2)
    expected = rng.uniform((0, 0), (640, 480), (1500, 2))
    some = expected[rng.random(1500) < 0.09].astype(np.float32)
    whole, coarse = (seen_from(expected, fitting(some, 0.01, v), CAMERA, CONFIG) for v in (1, 0.3))
    assert whole.evidence < CONFIG.min_evidence < coarse.evidence
