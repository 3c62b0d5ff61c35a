# SPDX-License-Identifier: Apache-2.0
"""Entry of `python -m tools.simworld`."""

import sys

from edge.runtime.kernel_cache import use_kernel_cache

use_kernel_cache()  # before Numba is imported

from tools.simworld.cli import main  # noqa: E402

sys.exit(main())
