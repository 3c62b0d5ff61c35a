# SPDX-License-Identifier: Apache-2.0
"""Statistics of durations in constant memory, however long the run."""

import numpy as np

_SMALLEST_MS = 1e-3
_LARGEST_MS = 1e6
_BINS_PER_E = 200  # bins half a per cent wide
_N_BINS = int(np.log(_LARGEST_MS / _SMALLEST_MS) * _BINS_PER_E) + 2


class Durations:
    """Counts durations by size.

    Quantiles are right to a quarter of a per cent, the largest duration exactly.
    """

    def __init__(self) -> None:
        self._counts = np.zeros(_N_BINS, np.int64)
        self._max_ms = 0.0

    def add(self, ms: float) -> None:
        """Count one duration."""
        place = np.log(max(ms, _SMALLEST_MS) / _SMALLEST_MS) * _BINS_PER_E
        self._counts[min(round(float(place)), _N_BINS - 1)] += 1
        self._max_ms = max(self._max_ms, ms)

    def summary(self) -> dict[str, float]:
        """Median, p95, p99 and max [ms]; all zero where nothing was counted."""
        quantiles = {"median": 0.5, "p95": 0.95, "p99": 0.99}
        found = {name: round(self._quantile(q), 3) for name, q in quantiles.items()}
        return found | {"max": round(self._max_ms, 3)}

    def _quantile(self, q: float) -> float:
        total = int(self._counts.sum())
        if total == 0:
            return 0.0
        place = int(np.searchsorted(np.cumsum(self._counts), q * total, side="left"))
        return min(float(_SMALLEST_MS * np.exp(place / _BINS_PER_E)), self._max_ms)
