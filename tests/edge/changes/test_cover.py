# SPDX-License-Identifier: Apache-2.0
"""Which shapes a mask of one thing can have."""

import cv2
import numpy as np
import pytest

from edge.changes.cover import is_solid
from edge.types import Mask


@pytest.mark.parametrize("angle_deg", [0.0, 20.0, 45.0, 80.0])
@pytest.mark.parametrize("sides_px", [(60, 60), (80, 8), (12, 7)])
def test_boxes_of_any_shape_are_solid_however_they_are_turned(
    angle_deg: float, sides_px: tuple[int, int]
) -> None:
    inside = np.zeros((120, 120), np.uint8)
    corners = cv2.boxPoints(((60.0, 60.0), sides_px, angle_deg))
    cv2.fillConvexPoly(inside, np.rint(corners).astype(np.int32), 1)

    assert is_solid(Mask(0, 0, inside > 0))


def test_a_disc_that_something_thin_crosses_is_solid() -> None:
    inside = np.zeros((60, 60), np.uint8)
    cv2.circle(inside, (30, 30), 25, 1, -1)
    inside[:, 26:34] = 0

    assert is_solid(Mask(3, 5, inside > 0))


def test_patches_far_apart_are_not() -> None:
    inside = np.zeros((60, 60), bool)
    inside[:12, :12] = inside[48:, 48:] = inside[:12, 48:] = True

    assert not is_solid(Mask(0, 0, inside))


@pytest.mark.parametrize("shape", [(0, 0), (5, 0), (4, 6)])
def test_a_mask_of_nothing_is_not(shape: tuple[int, int]) -> None:
    assert not is_solid(Mask(0, 0, np.zeros(shape, bool)))
