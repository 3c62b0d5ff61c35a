# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from edge.geometry import so3
from edge.geometry.covariance import largest_sigma, position_sigma, rotation_sigma


def test_the_worst_direction_counts_wherever_it_points() -> None:
    R = so3.exp(np.array([0.3, -0.7, 1.1]))
    block = R @ np.diag([0.01, 0.09, 0.04]) @ R.T
    assert largest_sigma(block) == pytest.approx(0.3)


def test_position_and_rotation_are_read_from_their_own_blocks() -> None:
    covariance = np.diag([4.0, 1.0, 1.0, 0.01, 0.25, 0.01])
    covariance[0, 4] = covariance[4, 0] = 0.9
    assert position_sigma(covariance) == pytest.approx(2.0)
    assert rotation_sigma(covariance) == pytest.approx(0.5)


def test_nothing_unsure_is_zero() -> None:
    assert largest_sigma(np.zeros((3, 3))) == 0.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_infinitely_unsure(bad: float) -> None:
    block = np.eye(3)
    block[1, 2] = bad
    assert largest_sigma(block) == math.inf


def test_what_is_no_covariance_is_infinitely_unsure() -> None:
    assert largest_sigma(-np.eye(3)) == math.inf
