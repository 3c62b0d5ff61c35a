# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from tools.bench.segmenter import p99_growth


@pytest.mark.parametrize("more", [0.0, 30.0])
def test_growth_of_the_slowest_poses_lies_within_what_seconds_drawn_anew_say(more: float) -> None:
    rng = np.random.default_rng(1)
    runs = [rng.gamma(4.0, 2.0, 700).tolist() for _ in range(2)]

    low, middle, high = p99_growth(runs, [[ms * (1.0 + 0.01 * more) for ms in run] for run in runs])

    assert middle == pytest.approx(more, abs=1e-6)
    assert low < more - 1.0
    assert high > more + 1.0


def test_one_bad_second_says_little() -> None:
    rng = np.random.default_rng(2)
    quiet = [rng.gamma(4.0, 2.0, 900).tolist() for _ in range(2)]
    disturbed = [[*quiet[0][:30], *(ms + 40.0 for ms in quiet[0][30:60]), *quiet[0][60:]], quiet[1]]

    low, middle, high = p99_growth(quiet, disturbed)

    assert low < 10.0 < middle < high
