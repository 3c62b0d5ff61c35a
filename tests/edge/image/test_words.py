# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.image.words import write_edged

INK, EDGE = (250.0, 250.0, 250.0), (10.0, 10.0, 10.0)


def test_the_edge_lies_around_the_words_and_nowhere_else() -> None:
    picture = np.full((60, 400, 3), 128, np.uint8)
    write_edged(picture, "dining table 0.58", (20, 40), 0.9, (INK, EDGE))
    bright, dark = picture[..., 0] > 200, picture[..., 0] < 60
    assert bright.any()
    assert dark.any()
    near = np.zeros_like(bright)
    for right in range(-4, 5):
        for down in range(-4, 5):
            near |= np.roll(bright, (down, right), (0, 1))
    assert not (dark & ~near).any()
