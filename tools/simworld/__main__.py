"""Entry of `python -m tools.simworld`."""

import sys

from tools.simworld.cli import main

sys.exit(main())
