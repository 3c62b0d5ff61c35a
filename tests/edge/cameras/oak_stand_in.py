# SPDX-License-Identifier: Apache-2.0
"""A process in the place of the one that talks to an OAK: it follows a script, given as JSON.

Steps: ["open", {...}], ["image", sequence], ["late", sequence], ["gone", reason],
["refuse", reason], ["sleep"], ["nonsense"], ["die", status].
"""

import json
import os
import sys
import time

import msgspec
import numpy as np

from edge.cameras.oak_link import Gone, ImageSlots, Opened, Order, Refused, Taken, rows_of, send

PERIOD_NS = 33_000_000


def picture(sequence: int, width: int, height: int) -> np.ndarray:
    return np.random.default_rng(sequence).integers(0, 256, (height, width), dtype=np.uint8)


def picture_with_colour(sequence: int, width: int, height: int) -> np.ndarray:
    """NV12: random grey, and one colour below it."""
    below = np.tile(np.array([60, 190], np.uint8), (height // 2, width // 2))
    return np.concatenate((picture(sequence, width, height), below))


def main() -> None:
    script = json.loads(sys.argv[1])
    order = msgspec.json.decode(sys.argv[2], type=Order)
    assert os.environ["DEPTHAI_TELEMETRY"] == "0"
    slots = ImageSlots(order.memory_fd, order.config.width, rows_of(order))
    paint = picture_with_colour if order.colour else picture
    mark = 0
    for step, *rest in script:
        if step == "open":
            send(order.messages_fd, Opened(**rest[0]))
        elif step in ("image", "late"):
            mark += 1
            image = paint(rest[0], order.config.width, order.config.height)
            slot = slots.write(mark, image)
            if step == "late":  # the writer has come round again before the reader looked
                slots.write(mark + 8, image)
            t_ns = (rest[0] + 1) * PERIOD_NS
            send(order.messages_fd, Taken(slot, mark, rest[0], t_ns, 5_000_000, 200))
        elif step == "gone":
            send(order.messages_fd, Gone(rest[0]))
        elif step == "refuse":
            send(order.messages_fd, Refused(rest[0]))
        elif step == "sleep":
            time.sleep(60.0)
        elif step == "nonsense":
            os.write(order.messages_fd, b"\x04\0\0\0\xff\xff\xff\xff")
        elif step == "die":
            os._exit(rest[0])


if __name__ == "__main__":
    main()
