# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.registration.drift_weights import FACTORS, FIRST_WEIGHTS, System, weighed
from edge.registration.fields import ROWS

M = 15 * ROWS


def drawn(factors: tuple[float, float], seed: int) -> System:
    """A system whose fixes err as they say, and whose odometry drifts by `factors`."""
    rng = np.random.default_rng(seed)
    roots = [np.tril(rng.normal(size=(M, M))) / np.sqrt(M) for _ in range(2)]
    drift = np.stack([root @ root.T for root in roots])
    noise = 1e-4 * np.eye(M)
    residual = np.linalg.cholesky(noise + np.tensordot(np.square(factors), drift, 1)) @ (
        rng.normal(size=M)
    )
    return System(residual, np.tile(np.eye(ROWS), (15, 1)), noise, drift)


@pytest.mark.parametrize("factors", [(0.1, 0.8), (0.8, 0.1), (0.4, 0.4)])
def test_the_likeliest_factors_are_those_that_the_fixes_were_drawn_from(
    factors: tuple[float, float],
) -> None:
    learnt = []
    for seed in range(5):
        weights = FIRST_WEIGHTS
        for _ in range(3):  # each part at the other's mean, as fix after fix does
            weights = weighed(drawn(factors, seed), weights)
        learnt.append(np.sqrt(weights @ FACTORS**2))
    np.testing.assert_allclose(np.median(learnt, axis=0), factors, rtol=0.35)


def test_fixes_that_tell_nothing_of_drift_leave_its_weights() -> None:
    system = drawn((0.4, 0.4), 0)
    system = system._replace(drift=np.zeros_like(system.drift))
    first = FIRST_WEIGHTS / FIRST_WEIGHTS.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(weighed(system, FIRST_WEIGHTS), first, rtol=1e-9)
