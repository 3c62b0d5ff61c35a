# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.changes.proof import CONFIRMED, Proof
from edge.types import Mask

MASK = Mask(90, 90, np.ones((20, 20), bool))


@pytest.mark.parametrize(
    ("pixel", "patch_px", "is_on"),
    [
        ((99.5, 99.5), 6.0, True),
        ((99.5, 91.5), 6.0, True),  # at its edge: half of the patch is of it
        ((99.5, 91.5), 30.0, False),  # so coarse that it shows what is all about
        ((99.5, 70.0), 6.0, False),
    ],
)
def test_a_patch_that_mostly_shows_what_is_beside_a_thing_tells_nothing_of_it(
    pixel: tuple[float, float], patch_px: float, is_on: bool
) -> None:
    points = np.array([7, 8], np.int32)  # the other one is not of it
    proof = Proof(
        points,
        np.zeros((2, 3)),
        np.array([pixel, pixel], np.float32),
        np.full(2, 2.0),
        np.full(2, patch_px),
        np.full(2, CONFIRMED, np.int32),
    )

    assert proof.on(np.array([3, 7], np.int32), MASK).tolist() == [0] * is_on
