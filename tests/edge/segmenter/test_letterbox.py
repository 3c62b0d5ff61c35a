# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.segmenter.contract import Fit
from edge.segmenter.letterbox import boxes_to_image, fill, image_from_input, lay_out

sides = st.integers(1, 3000)


@given(sides, sides, st.sampled_from([32, 64, 320, 416]), st.sampled_from([32, 96, 320]))
def test_an_image_fills_one_side_and_keeps_its_shape_to_half_a_pixel(
    w: int, h: int, W: int, H: int
) -> None:
    box = lay_out((w, h), (W, H), "centre")

    assert box.inner_width == W or box.inner_height == H
    assert 1 <= box.inner_width <= W
    assert 1 <= box.inner_height <= H
    scale = min(W / w, H / h)
    assert box.inner_width == pytest.approx(max(w * scale, 1), abs=0.5 + 1e-9)
    assert box.inner_height == pytest.approx(max(h * scale, 1), abs=0.5 + 1e-9)
    assert abs(W - box.inner_width - 2 * box.left) <= 1
    assert abs(H - box.inner_height - 2 * box.top) <= 1


@pytest.mark.parametrize("fit", ["centre", "corner", "stretch"])
def test_a_box_comes_back_where_the_image_was_laid(fit: Fit) -> None:
    image = np.full((45, 77), 200, np.uint8)
    box = lay_out((77, 45), (96, 64), fit)

    picture = fill(image, box, 0)

    rows, columns = np.nonzero(picture[:, :, 0])
    edges = np.array([[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]], np.float32)
    np.testing.assert_allclose(boxes_to_image(box, edges), [[-0.5, -0.5, 76.5, 44.5]], atol=1e-4)
    scale, shift = image_from_input(box)
    np.testing.assert_allclose(scale * edges[0, :2] + shift, [-0.5, -0.5], atol=1e-9)


def test_boxes_end_at_the_image() -> None:
    box = lay_out((128, 64), (64, 64), "centre")

    wild = np.array([[-1e6, -5.0, 1e6, 400.0]], np.float32)

    np.testing.assert_array_equal(boxes_to_image(box, wild), [[-0.5, -0.5, 127.5, 63.5]])
