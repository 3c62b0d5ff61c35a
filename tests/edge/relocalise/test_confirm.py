# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.geometry import se3
from edge.relocalise.assessment import Solution
from edge.relocalise.confirm import Attempt, stronger

CONFIG = RelocaliseConfig()


def attempt(gain: float, x_m: float = 0.0, reason: str = "ok") -> Attempt:
    T = se3.exp([x_m, 0, 0, 0, 0, 0])
    covariance = np.diag(np.repeat((0.01**2, 0.005**2), 3))
    solution = Solution(T, covariance, np.ones(50, bool), gain, 1.0, 20, 0.2, 2.0)
    return Attempt(reason, (1,), 50, solution)


def test_the_place_that_explains_more_wins() -> None:
    weak, strong = attempt(100.0), attempt(300.0, x_m=1.0)
    assert stronger(weak, strong, CONFIG) is strong
    assert stronger(strong, weak, CONFIG) is strong


def test_two_places_that_explain_alike_are_ambiguous() -> None:
    both = stronger(attempt(300.0), attempt(290.0, x_m=1.0), CONFIG)
    assert both.reason == "ambiguous"


def test_two_ways_to_one_place_are_not() -> None:
    assert stronger(attempt(300.0), attempt(290.0, x_m=0.005), CONFIG).reason == "ok"


def test_nothing_found_loses_to_anything() -> None:
    nothing = Attempt("no pose", (1,), 12)
    found = attempt(50.0, reason="position uncertain")
    assert stronger(nothing, found, CONFIG) is found
    assert stronger(nothing, nothing, CONFIG) is nothing
