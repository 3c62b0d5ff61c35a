# SPDX-License-Identifier: Apache-2.0
"""Balls of exact masks, seen by cameras on a circle."""

import numpy as np
import pytest
from numpy.typing import NDArray

from edge.changes.glimpse import glimpses
from edge.types import Detections, Mat4
from maps.labels.objects import View, group_objects
from tests.edge.changes.scenes import CAMERA, ball_detection, look_at_origin

Ball = tuple[int, NDArray[np.float64], float]
RED: Ball = (1, np.array([0.2, 0.0, 0.1]), 0.1)
BLUE: Ball = (2, np.array([-0.35, 0.1, 0.0]), 0.08)
ANGLES = (-40.0, -20.0, 0.0, 20.0, 40.0)


def view(angle_deg: float, balls: list[Ball], distance_m: float = 2.0) -> View:
    """An image of untextured balls, without points and depth."""
    T = look_at_origin(np.radians(angle_deg), distance_m)
    return of(T, ball_detection(balls, T))


def of(T: Mat4, seen: Detections) -> View:
    none = np.empty((0, 2), np.float32)
    return View(
        np.empty(0, np.int32), none, T, CAMERA, seen, glimpses(seen, T, CAMERA), none, np.empty(0)
    )


def with_points(angle_deg: float, balls: list[Ball], points: NDArray[np.float64]) -> View:
    """An image that sees map points as well."""
    plain = view(angle_deg, balls)
    local = (points - plain.T_map_cam[:3, 3]) @ plain.T_map_cam[:3, :3]
    pixels = CAMERA.project(local).astype(np.float32)
    return plain._replace(
        points=np.arange(len(points), dtype=np.int32),
        pixels=pixels,
        surface_pixels=pixels,
        surface_m=local[:, 2],
    )


def test_masks_without_any_point_are_grouped_by_their_place() -> None:
    red, blue = group_objects([view(a, [RED, BLUE]) for a in ANGLES])

    assert (red.label, blue.label) == (1, 2)
    assert np.linalg.norm(red.center - RED[1]) < 0.02
    assert np.linalg.norm(blue.center - BLUE[1]) < 0.02
    assert red.found.all()
    assert len(red.cameras) == len(ANGLES)
    np.testing.assert_allclose(red.extent_m[:2], 0.2, atol=0.08)  # nobody looked along x


def test_two_alike_things_side_by_side_stay_two() -> None:
    # At another height: in one plane with all cameras, lines of sight to either meet as well.
    twin: Ball = (1, RED[1] + (0.3, 0.1, 0.0), 0.1)

    things = group_objects([view(a, [RED, twin]) for a in ANGLES])

    assert len(things) == 2
    assert np.linalg.norm(things[0].center - things[1].center) == pytest.approx(0.316, abs=0.03)


def test_what_fewer_than_three_images_show_is_no_object() -> None:
    views = [view(a, [RED]) for a in (0.0, 20.0)] + [view(a, []) for a in (-20.0, 40.0)]

    assert group_objects(views) == []


def test_misses_of_the_model_are_counted_where_the_object_was_to_be_seen() -> None:
    views = [view(a, [RED]) for a in ANGLES] + [view(a, []) for a in (10.0, -10.0)]
    turned = look_at_origin(0.0, 2.0)
    turned[:3, :3] = turned[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    views.append(of(turned, ball_detection([], turned)))  # looks away

    (thing,) = group_objects(views)

    assert thing.hit_rate == pytest.approx(5 / 7)
    assert thing.found.tolist() == [True] * 5 + [False] * 2


def test_the_mask_of_what_it_stands_on_is_not_of_it() -> None:
    table: Ball = (9, np.array([0.2, 0.0, 0.6]), 0.5)
    angles = (0.0, 5.0, 10.0)
    views = [view(a, [RED]) for a in ANGLES] + [view(a, [table]) for a in angles]

    red = next(thing for thing in group_objects(views) if thing.label == RED[0])

    assert red.found.tolist() == [True] * len(ANGLES) + [False] * len(angles)


def test_an_image_in_which_something_stands_before_it_did_not_miss_it() -> None:
    near = np.array([[0.1 * i, 0.05 * j, -1.0] for i in range(-2, 5) for j in range(-3, 4)])
    views = [view(a, [RED]) for a in ANGLES] + [with_points(10.0, [], near)]

    (thing,) = group_objects(views)

    assert len(thing.cameras) == 5


def test_its_name_is_the_usual_one() -> None:
    # Points on it keep masks together that are named otherwise.
    rng = np.random.default_rng(3)
    away = rng.normal(size=(12, 3)) * (1.0, 1.0, 0.1) - (0.0, 0.0, 2.0)
    points = RED[1] + 0.09 * away / np.linalg.norm(away, axis=1, keepdims=True)
    views = [
        with_points(a, [(7 if i == 2 else 1, RED[1], RED[2])], points) for i, a in enumerate(ANGLES)
    ]

    (thing,) = group_objects(views)

    assert thing.label == 1
    assert thing.found.all()
    assert len(thing.cameras) == 5
