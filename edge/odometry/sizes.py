# SPDX-License-Identifier: Apache-2.0
"""How large the images are that the odometry works on."""

MAX_LEVELS = 5
MIN_LEVEL_PX = 1000


def halvings_to(pixels: int, limit: int) -> int:
    """How often an image of so many pixels is halved to have no more than `limit`."""
    count = 0
    while pixels > limit:
        pixels //= 4
        count += 1
    return count


def levels_of(pixels: int) -> int:
    """Levels of a pyramid above an image of so many pixels, itself counted."""
    count = 1
    while count < MAX_LEVELS and pixels // 4**count > MIN_LEVEL_PX:
        count += 1
    return count
