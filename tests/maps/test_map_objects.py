from collections.abc import Sequence

import numpy as np
import pytest

from edge.types import Detections, Mask
from maps.map_objects import View, group_objects

# Points in a row, 10 px apart in every image: 0-9 are one thing, 10-19 another, the rest the wall.
XYZ = np.stack([0.1 * np.arange(30), np.zeros(30), np.full(30, 2.0)], axis=1)


def view(
    masks: Sequence[tuple[int, int, int]], seen: Sequence[int] = range(30), x_m: float = 0.0
) -> View:
    """An image that sees these points; masks are (class, first point, last point)."""
    points = np.array(list(seen), np.int32)
    pixels = np.stack([10.0 * points + 5.0, np.full(len(points), 5.0)], axis=1)
    made = [Mask(10 * a, 0, np.ones((10, 10 * (b - a + 1)), dtype=bool)) for _, a, b in masks]
    n = len(masks)
    detections = Detections(
        np.zeros((n, 4), np.float32),
        np.linspace(0.9, 0.5, n).astype(np.float32),
        np.array([label for label, _, _ in masks], np.int32),
        tuple(made),
    )
    T = np.eye(4)
    T[0, 3] = x_m
    return View(points, pixels.astype(np.float32), T, detections)


def test_masks_of_the_same_points_are_one_object_under_its_usual_name() -> None:
    views = [
        view([(1, 0, 9), (2, 10, 19)], x_m=0.0),
        view([(1, 0, 9), (3, 10, 19)], x_m=0.5),
        view([(4, 0, 9), (2, 10, 19)], x_m=-1.0),
    ]

    first, second = group_objects(views, XYZ)

    assert (first.label, second.label) == (1, 2)
    np.testing.assert_array_equal(first.points, XYZ[:10])
    np.testing.assert_array_equal(second.points, XYZ[10:20])
    np.testing.assert_allclose(first.center, [0.45, 0.0, 2.0])
    np.testing.assert_allclose(np.linalg.norm(first.view_directions, axis=1), 1.0)
    assert first.view_distance_m == pytest.approx(np.hypot(1.45, 2.0))
    assert first.hit_rate == 1.0


def test_what_fewer_than_three_images_show_is_no_object() -> None:
    views = [view([(1, 0, 9)]), view([(1, 0, 9)]), view([]), view([])]

    assert group_objects(views, XYZ) == []


def test_misses_of_the_model_are_counted_where_the_object_was_to_be_seen() -> None:
    views = [view([(1, 0, 9)])] * 3 + [view([])] * 2 + [view([], seen=range(7, 30))] * 4

    (thing,) = group_objects(views, XYZ)

    assert thing.hit_rate == pytest.approx(3 / 5)


def test_an_object_mostly_out_of_an_image_is_still_the_same() -> None:
    views = [view([(1, 0, 9)])] * 3 + [view([(5, 6, 9)], seen=range(6, 30))]

    (thing,) = group_objects(views, XYZ)

    np.testing.assert_array_equal(thing.points, XYZ[:10])
    assert len(thing.view_directions) == 4


def test_a_mask_of_much_more_is_not_the_object() -> None:
    views = [view([(1, 4, 9)])] * 3 + [view([(2, 0, 25)])]

    (thing,) = group_objects(views, XYZ)

    assert len(thing.view_directions) == 3
    assert thing.hit_rate == pytest.approx(3 / 4)


def test_a_thing_on_a_table_is_not_the_table() -> None:
    views = [view([(1, 4, 9), (2, 0, 25)], x_m=0.1 * i) for i in range(4)]

    cup, table = group_objects(views, XYZ)

    assert (cup.label, table.label) == (1, 2)
    np.testing.assert_array_equal(cup.points, XYZ[4:10])
    assert len(table.points) == 20  # what the better mask holds is the cup's


def test_masks_that_spill_at_times_add_no_points() -> None:
    views = [view([(1, 0, 9)])] * 4 + [view([(1, 0, 14)])] * 3

    (thing,) = group_objects(views, XYZ)

    np.testing.assert_array_equal(thing.points, XYZ[:10])
