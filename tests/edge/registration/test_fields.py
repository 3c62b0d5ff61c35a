# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.geometry import so3
from edge.registration import fields
from edge.registration.fields import ROWS, Places

CONFIG = RegistrationConfig()
DEPTH_M = 2.0


def places(position: np.ndarray) -> Places:
    """Places on the way from the first to the last, which is in the origin; no turns."""
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    way = np.concatenate(([0.0], np.cumsum(steps)))
    way -= way[-1]
    position = position - position[-1]
    return Places(position, np.zeros((len(position), 9)), np.column_stack((way, 0.0 * way)))


def test_two_short_ways_add_the_drift_of_one_long_way() -> None:
    straight = np.array([[0.0, 0, 0], [0.3, 0, 0], [0.8, 0, 0]])
    at = places(straight)
    away = DEPTH_M * at.position[:2]
    whole = fields.drift(at, away, DEPTH_M, CONFIG)
    first = fields.drift(places(straight[:2]), away[:1] - away[1:], DEPTH_M, CONFIG)
    second = whole[:, ROWS:, ROWS:]
    carried = np.eye(ROWS)
    carried[:3, 3:6] = -so3.hat(away[0] - away[1])
    carried[:3, 6] = away[0] - away[1]
    np.testing.assert_allclose(
        whole[:, :ROWS, :ROWS], first + carried @ second @ carried.T, rtol=1e-9, atol=1e-15
    )


def test_places_that_lie_together_err_together() -> None:
    at = places(np.array([[0.5, 0.1, 0.0], [0.5, 0.1, 0.0], [0.0, 0.0, 0.0]]))
    C = fields.drift(at, DEPTH_M * at.position[:2], DEPTH_M, CONFIG)
    np.testing.assert_allclose(C[:, :ROWS, ROWS:], C[:, :ROWS, :ROWS], rtol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_covariances_are_positive(seed: int) -> None:
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(0.0, 0.2, (12, 3)), axis=0)
    turned = np.stack([so3.exp(w).ravel() / math.sqrt(2.0) for w in rng.normal(0.0, 1.0, (12, 3))])
    way = np.column_stack((np.linspace(-4.0, 0.0, 12), np.linspace(-9.0, 0.0, 12)))
    at = Places(walk - walk[-1], turned, way)
    drift = fields.drift(at, DEPTH_M * at.position[:-1], DEPTH_M, CONFIG)
    assert np.linalg.eigvalsh(drift).min() > -1e-12
    roots = rng.normal(0.0, 0.01, (2, 12, ROWS, ROWS))
    assert np.linalg.eigvalsh(fields.shared(roots, at, CONFIG))[0] > -1e-12


def test_common_errors_are_forgotten_on_the_way() -> None:
    at = places(np.array([[9.0, 0, 0], [0.1, 0, 0], [0.0, 0, 0]]))
    roots = np.tile(0.01 * np.eye(ROWS), (1, 3, 1, 1))
    C = fields.shared(roots, at, CONFIG)
    near, far = C[ROWS, 2 * ROWS], C[0, 2 * ROWS]
    assert near > 0.8e-4
    assert far < 1e-7
    assert C[ROWS + 6, 2 * ROWS + 6] > near  # the scale keeps its own for longer
