# SPDX-License-Identifier: Apache-2.0
"""Brings images to a model's input size and boxes back, in exact integers."""

from typing import NamedTuple

import cv2
import numpy as np

from edge.segmenter.contract import Fit
from edge.types import F32, F64, U8


class Letterbox(NamedTuple):
    """The scaled image's place inside the model's input, all in whole pixels."""

    image_width: int
    image_height: int
    input_width: int
    input_height: int
    inner_width: int
    inner_height: int
    left: int
    top: int


def lay_out(image: tuple[int, int], model: tuple[int, int], fit: Fit) -> Letterbox:
    """Place of an image in the input; both sizes are (width, height)."""
    (w, h), (W, H) = image, model
    if fit == "stretch":
        return Letterbox(w, h, W, H, W, H, 0, 0)
    # Rounded half up in integers: floating point would decide by its last bit.
    if W * h <= H * w:
        inner_w, inner_h = W, max(1, (2 * h * W + w) // (2 * w))
    else:
        inner_w, inner_h = max(1, (2 * w * H + h) // (2 * h)), H
    if fit == "corner":
        return Letterbox(w, h, W, H, inner_w, inner_h, 0, 0)
    return Letterbox(w, h, W, H, inner_w, inner_h, (W - inner_w) // 2, (H - inner_h) // 2)


def fill(image: U8, box: Letterbox, pad: int) -> U8:
    """Input picture (H, W, 3) uint8 of an image (h, w) grey or (h, w, 3)."""
    if image.ndim == 2:
        image = np.repeat(image[:, :, None], 3, axis=2)
    out: U8 = np.full((box.input_height, box.input_width, 3), pad, np.uint8)
    inner = out[box.top : box.top + box.inner_height, box.left : box.left + box.inner_width]
    size = (box.inner_width, box.inner_height)
    inner[:] = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return out


def boxes_to_image(box: Letterbox, boxes: F32) -> F32:
    """Boxes (n, 4) left, top, right, bottom of the input, as a model counts them, in the image.

    A model's pixel i reaches from i to i + 1, ours from i - 0.5 to i + 0.5. They are clipped.
    """
    scale, shift = image_from_input(box)
    moved = boxes.astype(np.float64).reshape(-1, 2, 2) * scale + shift
    limit = np.array([box.image_width - 0.5, box.image_height - 0.5])
    clipped: F32 = np.clip(moved, -0.5, limit).reshape(-1, 4).astype(np.float32)
    return clipped


def image_from_input(box: Letterbox) -> tuple[F64, F64]:
    """Scale (2,) and shift (2,) from the model's coordinates of edges to our pixels."""
    scale = np.array([box.image_width / box.inner_width, box.image_height / box.inner_height])
    return scale, -scale * np.array([box.left, box.top]) - 0.5
