# SPDX-License-Identifier: Apache-2.0
"""What processes beside the daemon get to see of its environment."""

import os
from pathlib import Path


def child_environment() -> dict[str, str]:
    """As ours; nothing in it makes threads."""
    root = str(Path(__file__).resolve().parents[2])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return {**os.environ, **one, "PYTHONPATH": os.pathsep.join(paths)}
