# SPDX-License-Identifier: Apache-2.0
"""What is blown out or lost in the dark says nothing against a pose."""

import numpy as np

from edge.geometry.camera import CameraModel
from edge.relocalise.exposure import can_show, clipped

CAMERA = CameraModel(
    160, 120, 100.0, 100.0, 79.5, 59.5, distortion_model="radtan", distortion=(-0.25, 0.0, 0.0, 0.0)
)
RNG = np.random.default_rng(0)
TEXTURE = RNG.integers(20, 230, (120, 160)).astype(np.uint8)


def test_an_image_that_shows_all_has_no_mask() -> None:
    assert clipped(TEXTURE) is None
    sparkling = TEXTURE.copy()
    sparkling[::13, ::13] = 255  # lamps, a highlight here and there
    assert clipped(sparkling) is None


def test_clipped_patches_are_found_by_their_raw_pixels() -> None:
    for grey in (255, 0):
        image = TEXTURE.copy()
        image[:, 90:] = grey
        mask = clipped(image)
        pixels = np.array([[20.0, 60.0], [130.0, 60.0], [150.0, 10.0], [79.0, 60.0]])
        assert can_show(mask, pixels, CAMERA).tolist() == [True, False, False, True]


def test_the_mask_is_of_the_bent_image() -> None:
    image = TEXTURE.copy()
    image[:, 148:] = 255
    ideal = np.array([[150.0, 20.0]])
    assert CAMERA.distort_pixels(ideal)[0, 0] < 140.0  # the lens draws it inwards
    assert can_show(clipped(image), ideal, CAMERA)[0]


def test_without_a_mask_everything_shows() -> None:
    assert can_show(None, np.zeros((3, 2)), CAMERA).all()
