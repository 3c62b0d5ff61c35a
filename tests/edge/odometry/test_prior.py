# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.odometry.prior import MarginalPrior


def test_a_frame_that_rounding_left_below_zero_can_leave() -> None:
    prior = MarginalPrior(2)
    prior.H = 1e4 * np.eye(16)
    prior.H[2, 2] = -40.0
    prior.eliminate(0)
    assert prior.H.shape == (8, 8)
    np.testing.assert_allclose(prior.H, 1e4 * np.eye(8))
    assert np.all(np.isfinite(prior.b))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_no_number_leaves_nothing_behind(bad: float) -> None:
    prior = MarginalPrior(2)
    H, b = np.eye(16), np.ones(16)
    H[3, 4] = H[4, 3] = bad
    prior.add(H, b, [])
    prior.add(np.eye(16), b * bad, [])
    assert prior.is_empty
    prior.eliminate(1)
    assert prior.H.shape == (8, 8)
