# SPDX-License-Identifier: Apache-2.0
"""A block that was two boxes side by side, under one mask, from around its front."""

import numpy as np
import pytest

from edge.changes.carving import Carving
from edge.changes.parting import parted
from edge.types import F64, Bools

AXIS = np.linspace(-0.1, 0.1, 7)
BOX = np.stack(np.meshgrid(AXIS, AXIS, AXIS), axis=-1).reshape(-1, 3)
BLOCK = np.concatenate((BOX, BOX + np.array([0.22, 0.0, 0.0])))
IS_RIGHT = np.arange(len(BLOCK)) >= len(BOX)


def seen(held: Bools, n: int = 10, tested: Bools | None = None) -> Carving:
    """From so many viewpoints, each point held or not, but for some that chance decides."""
    carving, rng = Carving(len(BLOCK)), np.random.default_rng(5)
    every = np.ones(len(BLOCK), bool) if tested is None else tested
    for viewpoint in range(n):
        carving.add(viewpoint, every, held ^ (rng.random(len(BLOCK)) < 0.05))
    return carving


def between(low: float, high: float) -> Bools:
    inside: Bools = (BLOCK[:, 0] > low) & (BLOCK[:, 0] < high)
    return inside


@pytest.mark.parametrize("turn", [np.eye(3), np.linalg.qr(np.arange(9.0).reshape(3, 3) ** 2)[0]])
def test_one_of_two_boxes_is_gone(turn: F64) -> None:
    part = parted(BLOCK @ turn, seen(~IS_RIGHT))

    assert part is not None
    np.testing.assert_array_equal(part, IS_RIGHT)


@pytest.mark.parametrize(
    ("held", "n"),
    [
        (IS_RIGHT | ~IS_RIGHT, 20),  # nothing has gone
        (IS_RIGHT & ~IS_RIGHT, 20),  # all of it has: who misses the whole tells of that
        (~IS_RIGHT, 7),  # too few viewpoints
        (~between(0.27, 1.0), 20),  # its edge, thinner than masks are exact
        (between(-0.05, 0.27), 20),  # both ends: the space was larger than the thing
        (np.arange(len(BLOCK)) % 2 == 0, 20),  # here and there
    ],
)
def test_what_is_no_part_of_it_has_not_gone(held: Bools, n: int) -> None:
    assert parted(BLOCK, seen(held, n)) is None


def test_what_images_hardly_tell_of_has_not_gone() -> None:
    assert parted(BLOCK, seen(~IS_RIGHT, tested=~IS_RIGHT)) is None
