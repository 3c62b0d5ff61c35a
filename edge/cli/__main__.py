# SPDX-License-Identifier: Apache-2.0
"""Lets `python -m edge.cli` be `mapvo`."""

import sys

from edge.cli import main

if __name__ == "__main__":
    sys.exit(main())
