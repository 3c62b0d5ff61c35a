# SPDX-License-Identifier: Apache-2.0
import cv2
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
    assert abs(pixels.sum() - side**2) < 3 * side
    rows, columns = np.nonzero(image[:, :, 0] > 127)
    assert abs(columns.mean() - 159.5) < 1.0
    assert abs(rows.max() - (119.5 + 0.1 / 2.0 * 300.0)) < 1.5


def test_the_middle_of_a_thing_seen_from_above_is_where_it_is() -> None:
    made, high = scene(np.empty((0, 3))), np.radians(40.0)
    # From 2 m away and 40 degrees above, looking at its foot.
    made.poses = np.eye(4)[None].copy()
    made.poses[0, :3, :3] = cv2.Rodrigues(np.array([-high, 0.0, 0.0]))[0]
    made.poses[0, :3, 3] = thing().foot - 2.0 * made.poses[0, :3, 2]
    blank = np.zeros((240, 320, 3), np.uint8)

    _, pixels = made.paint(blank, 0, thing())

    rows, columns = np.nonzero(pixels)
    (middle,), _ = made.pixels_at(0, thing().center[None])
    assert abs(columns.mean() - middle[0]) < 1.0
    assert abs(rows.mean() - middle[1]) < 1.0


def test_what_is_before_a_thing_hides_it_and_what_is_behind_does_not() -> None:
    blank = np.zeros((240, 320, 3), np.uint8)
    x, y = np.meshgrid(np.linspace(-0.2, 0.0, 60), np.linspace(-0.2, 0.2, 60))
    left = np.column_stack([x.ravel(), y.ravel()])

    _, whole = scene(np.column_stack([left, np.full(len(left), 3.0)])).paint(blank, 0, thing())
    image, shown = scene(np.column_stack([left, np.full(len(left), 1.0)])).paint(blank, 0, thing())

    assert whole.sum() > 800
    assert 0.3 * whole.sum() < shown.sum() < 0.7 * whole.sum()
    assert np.nonzero(image[:, :, 0] > 127)[1].min() > 150


def test_what_lies_flat_is_seen_in_perspective() -> None:
    made = scene(np.empty((0, 3)))
    # The ground is level, 0.5 m below the camera.
    made.up, made.axes = np.array([0.0, -1.0, 0.0]), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    made._height = -0.5
    sheet = thing().thing._replace(is_flat=True, foot_px=np.array([19.5, 19.5]))
    blank = np.zeros((240, 320, 3), np.uint8)

    lying = Stand(sheet, made.on_ground(np.array([[0.0, 2.0]]))[0], made.up)
    _, pixels = made.paint(blank, 0, lying)

    rows, columns = np.nonzero(pixels)
    near, far = columns[rows == rows.max()], columns[rows == rows.min()]
    assert abs(rows.max() - (119.5 + 0.5 / 1.9 * 300.0)) < 1.5
    assert abs(rows.min() - (119.5 + 0.5 / 2.1 * 300.0)) < 1.5
    assert abs(np.ptp(near) - 0.2 / 1.9 * 300.0) < 2.0
    assert abs(np.ptp(far) - 0.2 / 2.1 * 300.0) < 2.0


def test_only_what_is_free_of_things_is_ground_to_stand_on() -> None:
    made = scene(np.empty((0, 3)))
    made.up, made.axes = np.array([0.0, 0.0, 1.0]), np.eye(3)[:2]
    made._height = 0.0
    u, v = np.meshgrid(np.arange(0.0, 1.0, 0.01), np.arange(0.0, 0.8, 0.01))
    table = np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)])
    box = table[(u.ravel() > 0.6) & (v.ravel() > 0.4)] + (0.0, 0.0, 0.1)
    made.xyz = np.concatenate([table, box])

    free = made._free_ground(table)

    assert not ((free > (0.62, 0.42)) & (free < (0.98, 0.78))).all(axis=1).any()
    assert abs(len(free) * 0.02**2 - (0.8 - 0.4 * 0.4)) < 0.06
