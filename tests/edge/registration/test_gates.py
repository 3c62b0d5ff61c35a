# SPDX-License-Identifier: Apache-2.0
import pytest

from edge.registration.gates import chi2_quantile


@pytest.mark.parametrize("degrees", [1, 2, 6, 7])
@pytest.mark.parametrize("probability", [0.05, 0.5, 0.95, 0.999])
def test_quantile_is_scipys(probability: float, degrees: int) -> None:
    from scipy.stats import chi2

    expected = chi2.ppf(probability, degrees)
    assert chi2_quantile(probability, degrees) == pytest.approx(expected, rel=1e-9)
