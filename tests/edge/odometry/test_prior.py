# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.odometry.prior import MarginalPrior


def test_a_frame_that_rounding_left_below_zero_can_leave() -> None:
    prior = MarginalPrior(2)
    prior.H = 1e4 * np.eye(16)
    prior.H[2, 2] = -40.0
    prior.eliminate(0)
    assert prior.H.shape == (8, 8)
    np.testing.assert_allclose(prior.H, 1e4 * np.eye(8))
    assert np.all(np.isfinite(prior.b))
