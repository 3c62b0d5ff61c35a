# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.types import Pinhole
from tools.bench.changes_scene import Cutout, Scene, Stand

CAMERA = Pinhole(320, 240, 300.0, 300.0, 159.5, 119.5)


def scene(xyz: np.ndarray) -> Scene:
    made = Scene.__new__(Scene)
    made.camera, made.poses, made.xyz = CAMERA, np.eye(4)[None], xyz
    return made


def thing() -> Stand:
    """A white sheet, 0.2 m wide and high, 2 m before the camera."""
    white = np.full((40, 40, 3), 255, np.uint8)
    alpha = np.full((40, 40), 255, np.uint8)
    cutout = Cutout("cup", white, alpha, np.array([19.5, 39.0]), np.array([0.0, -1.0]), 0.005)
    return Stand(cutout, np.array([0.0, 0.1, 2.0]), np.array([0.0, -1.0, 0.0]))


def test_a_thing_is_as_large_as_its_distance_makes_it() -> None:
    blank = np.zeros((240, 320, 3), np.uint8)

    image, pixels = scene(np.empty((0, 3))).paint(blank, 0, thing())

    side = 0.2 / 2.0 * 300.0
    assert abs(pixels - side**2) < 3 * side
    rows, columns = np.nonzero(image[:, :, 0] > 127)
    assert abs(columns.mean() - 159.5) < 1.0
    assert abs(rows.max() - (119.5 + 0.1 / 2.0 * 300.0)) < 1.5


def test_what_is_before_a_thing_hides_it_and_what_is_behind_does_not() -> None:
    blank = np.zeros((240, 320, 3), np.uint8)
    x, y = np.meshgrid(np.linspace(-0.2, 0.0, 60), np.linspace(-0.2, 0.2, 60))
    left = np.column_stack([x.ravel(), y.ravel()])

    _, whole = scene(np.column_stack([left, np.full(len(left), 3.0)])).paint(blank, 0, thing())
    image, shown = scene(np.column_stack([left, np.full(len(left), 1.0)])).paint(blank, 0, thing())

    assert whole > 800
    assert 0.3 * whole < shown < 0.7 * whole
    assert np.nonzero(image[:, :, 0] > 127)[1].min() > 150
