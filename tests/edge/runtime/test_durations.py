# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.runtime.durations import Durations


@pytest.mark.parametrize("spread", [0.1, 1.0, 3.0])
def test_quantiles_are_right_to_a_quarter_of_a_per_cent(spread: float) -> None:
    values = np.exp(np.random.default_rng(0).normal(1.0, spread, 20_000))
    durations = Durations()
    for value in values:
        durations.add(float(value))
    summary = durations.summary()
    for name, q in (("median", 0.5), ("p95", 0.95), ("p99", 0.99)):
        exact = np.quantile(values, q, method="inverted_cdf")
        assert summary[name] == pytest.approx(exact, rel=2.6e-3, abs=1e-3)
    assert summary["max"] == pytest.approx(values.max(), abs=1e-3)


@pytest.mark.parametrize("value", [0.0, 1e-9, 1e9])
def test_extremes_are_counted(value: float) -> None:
    durations = Durations()
    durations.add(value)
    assert durations.summary()["max"] == pytest.approx(value, abs=1e-3)


def test_nothing_counted_is_zero() -> None:
    assert set(Durations().summary().values()) == {0.0}
