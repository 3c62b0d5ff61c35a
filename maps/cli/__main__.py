# SPDX-License-Identifier: Apache-2.0
"""Lets `python -m maps.cli` be `mapvo-map`."""

import sys

from maps.cli import main

if __name__ == "__main__":
    sys.exit(main())
