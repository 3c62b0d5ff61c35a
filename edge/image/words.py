# SPDX-License-Identifier: Apache-2.0
"""Words on a picture that are readable on any ground."""

import cv2

from edge.types import U8

FONT = cv2.FONT_HERSHEY_SIMPLEX

Colour = tuple[float, float, float]


def write_edged(
    picture: U8, text: str, at: tuple[int, int], size: float, colours: tuple[Colour, Colour]
) -> None:
    """Write `text` with its lower left corner `at`, in the first colour, edged by the second.

    The edge is the same thin words beside themselves: thicker ones of OpenCV 5 are wider.
    """
    ink, edge = colours
    for right, down in ((-1, -1), (-1, 1), (1, -1), (1, 1), (0, -2), (0, 2), (-2, 0), (2, 0)):
        place = (at[0] + right, at[1] + down)
        cv2.putText(picture, text, place, FONT, size, edge, 1, cv2.LINE_AA)
    cv2.putText(picture, text, at, FONT, size, ink, 1, cv2.LINE_AA)
