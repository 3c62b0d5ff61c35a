# SPDX-License-Identifier: Apache-2.0
"""Quantiles that gates compare with, without scipy.stats and its half second of import."""

import functools
import math


@functools.cache
def chi2_quantile(probability: float, degrees: int) -> float:
    """Value below which a chi-square of `degrees` degrees of freedom lies with `probability`."""
    low, high = 0.0, 10.0 * degrees + 100.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        if _chi2_below(middle, degrees) < probability:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _chi2_below(value: float, degrees: int) -> float:
    """Probability of a chi-square below `value`: series of the incomplete gamma function."""
    if value <= 0.0:
        return 0.0
    a, x = 0.5 * degrees, 0.5 * value
    term = total = 1.0 / a
    n = a
    while term > total * 1e-16:
        n += 1.0
        term *= x / n
        total += term
    return total * math.exp(-x + a * math.log(x) - math.lgamma(a))
