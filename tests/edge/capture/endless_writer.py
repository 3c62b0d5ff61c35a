# SPDX-License-Identifier: Apache-2.0
"""Records for ever, for tests that kill it: `python -m tests.edge.capture.endless_writer FILE`."""

import itertools
import sys
from pathlib import Path

from edge.capture import format as format_
from edge.capture.writer import CaptureWriter
from tests.edge.capture.captures import PERIOD_NS, SCHEMAS, header, picture

if __name__ == "__main__":
    images = [picture(number) for number in range(20)]
    with CaptureWriter(Path(sys.argv[1]), header(), SCHEMAS) as writer:
        for number in itertools.count():
            writer.add_image(number * PERIOD_NS, number, images[number % 20])
            writer.add_row(format_.STATE, number * PERIOD_NS, b"{}")
