# SPDX-License-Identifier: Apache-2.0
"""Settings that must stand before Numba, OpenCV or a BLAS is imported."""

import os
from pathlib import Path

from edge.runtime.kernel_cache import use_kernel_cache

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"
use_kernel_cache(Path(__file__).parents[1] / ".numba_cache")
