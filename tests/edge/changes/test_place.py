# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from numpy.typing import NDArray

from edge.changes.glimpse import Glimpse, glimpses
from edge.changes.place import carve, fits, locate
from tests.edge.changes.scenes import CAMERA, ball_detection, look_at_origin

CENTER = np.array([0.1, -0.05, 0.2])
RADIUS_M = 0.12


def ball_seen(
    angles_deg: tuple[float, ...], center: NDArray[np.float64] = CENTER, distance_m: float = 2.0
) -> list[Glimpse]:
    seen = []
    for angle in angles_deg:
        T = look_at_origin(np.radians(angle), distance_m)
        seen += glimpses(ball_detection([(3, center, RADIUS_M)], T), T, CAMERA)
    return seen


def test_lines_of_sight_meet_where_the_thing_is() -> None:
    place = locate(ball_seen((-15.0, 0.0, 15.0)))

    assert place is not None
    assert np.linalg.norm(place.center - CENTER) < 0.01
    assert place.radius_m == pytest.approx(RADIUS_M, rel=0.05)
    assert 0.005 < place.sigma_m < 0.1


def test_a_line_of_sight_of_another_thing_does_not_move_the_place() -> None:
    seen = ball_seen((-15.0, -10.0, -5.0, 5.0, 10.0, 15.0))
    (other,) = ball_seen((0.0,), CENTER + np.array([0.8, 0.3, 0.0]))

    place = locate([other, *seen])

    assert place is not None
    assert np.linalg.norm(place.center - CENTER) < 0.02


def test_views_from_one_place_do_not_tell_the_distance() -> None:
    place = locate(ball_seen((0.0, 0.3)))

    assert place is None or place.sigma_m > 0.5


def test_a_measured_front_tells_the_distance_of_the_middle() -> None:
    (seen,) = ball_seen((0.0,))
    front = float(np.linalg.norm(CENTER - seen.origin)) - 0.6 * RADIUS_M

    place = locate([seen._replace(distance_m=front, distance_sigma_m=0.02)])

    assert place is not None
    assert np.linalg.norm(place.center - CENTER) < 0.02


def test_another_thing_beside_it_and_one_of_another_size_do_not_fit() -> None:
    place = locate(ball_seen((-15.0, 0.0, 15.0)))
    assert place is not None

    (same,) = ball_seen((8.0,))
    (beside,) = ball_seen((8.0,), CENTER + np.array([0.25, 0.0, 0.0]))
    T = look_at_origin(np.radians(8.0), 2.0)
    (large,) = glimpses(ball_detection([(3, CENTER, 3.0 * RADIUS_M)], T), T, CAMERA)

    assert fits(same, place) > 0.7
    assert fits(beside, place) <= 0.0
    assert fits(large, place) <= 0.0
    assert fits(same._replace(distance_m=0.8, distance_sigma_m=0.05), place) == 0.0


def test_what_all_masks_hold_is_the_space_of_the_thing() -> None:
    seen = ball_seen((-60.0, -30.0, 0.0, 30.0, 60.0))
    place = locate(seen)
    assert place is not None

    points = carve(seen, place)

    assert np.linalg.norm(points.mean(axis=0) - CENTER) < 0.02
    assert np.linalg.norm(points - CENTER, axis=1).max() < 1.5 * RADIUS_M
    np.testing.assert_allclose(np.ptp(points, axis=0), 2.0 * RADIUS_M, rtol=0.35)


def test_ranges_that_are_all_of_the_wall_behind_do_not_move_a_thing_there() -> None:
    behind_m = 0.2
    seen = [
        g._replace(
            distance_m=float(np.linalg.norm(CENTER - g.origin)) + behind_m, distance_sigma_m=0.1
        )
        for g in ball_seen(tuple(np.linspace(-25.0, 25.0, 60)))
    ]

    place = locate(seen)

    assert place is not None
    assert np.linalg.norm(place.center - CENTER) < 0.3 * behind_m
