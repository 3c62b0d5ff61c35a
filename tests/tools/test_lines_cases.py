# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from tools.bench.lines_cases import plane_error_m, solved, trial


@pytest.mark.slow
def test_lines_of_a_plane_lie_in_it_within_a_millimetre() -> None:
    given, n = plane_error_m(0, 0.5, given_poses=True)
    assert given < 1.0e-3
    assert n >= 14
    alone, _ = plane_error_m(0, 0.5, given_poses=False)
    assert alone < 1.5e-3  # one of many seeds, whose mean is below one


def test_a_far_start_counts_as_right_where_the_minimum_at_the_truth_was_found() -> None:
    rng = np.random.default_rng(1)
    right, minima, rounds = solved(rng, trial(rng, 12, 60.0, flat=False), 1.0, 0.01)
    assert right
    assert minima == 1
    assert 5 < rounds < 200
