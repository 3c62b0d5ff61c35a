# SPDX-License-Identifier: Apache-2.0
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from edge.changes.glimpse import glimpses
from edge.changes.newcomer import Newcomer
from edge.changes.newcomers import Newcomers
from edge.changes.proof import CONFIRMED, CONTRADICTED, Proof
from edge.config.changes import ChangesConfig
from edge.geometry import se3
from edge.tiles.labels import MapObject
from edge.types import F32, Look, Mat4
from tests.edge.changes.scenes import (
    CAMERA,
    HALF_M,
    NOTHING,
    ball_detection,
    box_object,
    look_at_origin,
)

CONFIG = ChangesConfig()
NO_PROOF = Proof(
    np.empty(0, np.int32),
    np.empty((0, 3)),
    np.empty((0, 2), np.float32),
    np.empty(0),
    np.empty(0),
    np.empty(0, np.int32),
)


def seen_from(newcomer: Newcomer, angles_deg: np.ndarray, center: np.ndarray) -> None:
    for angle in angles_deg:
        T = look_at_origin(np.radians(angle), 2.0)
        (glimpse,) = glimpses(ball_detection([(3, center, 0.06)], T), T, CAMERA)
        look = Look(0, 0, np.empty((0, 0), np.uint8), T, np.empty((0, 3)), NOTHING)
        newcomer.add(glimpse, look, NO_PROOF)


def test_views_of_a_camera_that_moves_on_place_better_what_it_saw_for_long() -> None:
    newcomer = Newcomer()
    center = np.array([0.1, 0.0, 0.0])
    seen_from(newcomer, np.linspace(0.0, 2.0, 80), center)
    assert newcomer.place is not None
    before = newcomer.place.sigma_m

    seen_from(newcomer, np.linspace(2.0, 40.0, 20), center)

    assert newcomer.place.sigma_m < 0.5 * before
    assert len(newcomer.glimpses) == len(newcomer.evidence) <= 60
    spread = newcomer.glimpses[-1].ray @ newcomer.glimpses[0].ray
    assert spread < np.cos(np.radians(30.0))


@pytest.mark.parametrize(("aside_m", "apart"), [(4.0 * HALF_M, True), (1.2 * HALF_M, False)])
def test_what_is_beside_a_thing_of_the_map_is_not_that(aside_m: float, apart: bool) -> None:
    newcomer = Newcomer()
    seen_from(newcomer, np.linspace(-20.0, 20.0, 10), np.array([aside_m, 0.0, 0.0]))

    assert newcomer.is_apart(box_object(), CONFIG) == apart


def test_what_the_map_saw_there_before_is_not_apart_from_what_it_knows() -> None:
    newcomer = Newcomer()
    seen_from(newcomer, np.linspace(-20.0, 20.0, 10), np.array([4.0 * HALF_M, 0.0, 0.0]))
    newcomer.is_of_map = True

    assert not newcomer.is_apart(box_object(), CONFIG)


def test_what_was_seen_once_is_nowhere_surely() -> None:
    newcomer = Newcomer()
    seen_from(newcomer, np.array([0.0]), np.array([0.5, 0.0, 0.0]))

    assert not newcomer.is_apart(box_object(), CONFIG)


def test_what_is_new_may_hide_what_is_behind_it_and_nothing_else() -> None:
    newcomers = Newcomers(CAMERA, CONFIG)
    for i, angle in enumerate(np.linspace(-10.0, 10.0, 5)):
        T = look_at_origin(np.radians(angle), 2.0)
        seen = ball_detection([(3, np.zeros(3), 0.1)], T)
        look = Look(i, 10**8 * i, np.empty((0, 0), np.uint8), T, np.empty((0, 3)), seen)
        masks = glimpses(seen, T, CAMERA)
        newcomers.step(look, masks, masks, NO_PROOF)

    T = look_at_origin(0.0, 2.0)
    over = CAMERA.project(np.array([[0.0, 0.0, 2.0], [0.03, 0.0, 2.0]])).astype(np.float32)
    aside = CAMERA.project(np.array([[0.5, 0.0, 2.0], [0.0, 0.4, 2.0]])).astype(np.float32)

    assert newcomers.may_hide(over, 3.0, T)
    assert not newcomers.may_hide(over, 1.5, T)
    assert not newcomers.may_hide(aside, 3.0, T)


def test_a_part_of_what_is_new_is_not_new_itself() -> None:
    newcomers = Newcomers(CAMERA, CONFIG)
    T = look_at_origin(0.0, 2.0)
    whole, part = ((0.0, 0.1), (0.03, 0.05))
    balls = [(3, np.array([x, 0.0, 0.0]), radius) for x, radius in (whole, part)]
    seen = glimpses(ball_detection(balls, T), T, CAMERA)
    look = Look(0, 0, np.empty((0, 0), np.uint8), T, np.empty((0, 3)), NOTHING)

    newcomers.step(look, seen, seen, NO_PROOF)
    (followed,) = newcomers._followed
    assert followed.glimpses[0] is seen[0]


@pytest.mark.parametrize(("radius_m", "sure"), [(0.08, False), (0.2, True)])
def test_a_large_thing_need_not_be_placed_as_exactly_as_a_small_one(
    radius_m: float, sure: bool
) -> None:
    newcomer = Newcomer()
    seen_from(newcomer, np.linspace(-20.0, 20.0, 10), np.zeros(3))
    assert newcomer.place is not None
    newcomer.place = newcomer.place._replace(covariance=np.eye(3) * 0.07**2, radius_m=radius_m)

    assert newcomer.is_sure(CONFIG) == sure


@pytest.mark.parametrize(("hidden", "sure"), [(9, False), (10, True)])
def test_what_hides_much_of_the_map_need_not_be_placed_as_exactly(hidden: int, sure: bool) -> None:
    newcomer = Newcomer()
    seen_from(newcomer, np.linspace(-20.0, 20.0, 10), np.zeros(3))
    assert newcomer.place is not None
    newcomer.place = newcomer.place._replace(covariance=np.eye(3) * 0.07**2, radius_m=0.13)
    newcomer._other = Counter(dict.fromkeys(range(hidden), 2))

    assert newcomer.is_sure(CONFIG) == sure


@pytest.mark.parametrize(("surely", "sure"), [(0, False), (1, False), (2, True)])
def test_faint_masks_begin_nothing_and_tell_of_what_sure_ones_began(
    surely: int, sure: bool
) -> None:
    newcomers = Newcomers(CAMERA, CONFIG)
    for i, angle in enumerate(np.linspace(-20.0, 20.0, 8)):
        T = look_at_origin(np.radians(angle), 2.0)
        found = ball_detection([(3, np.zeros(3), 0.06)], T)
        (g,) = glimpses(found, T, CAMERA, lambda _: (1.94, 0.1), are_faint=i >= surely)
        look = Look(i, 10**8 * i, np.empty((0, 0), np.uint8), T, np.empty((0, 3)), NOTHING)
        assert newcomers.awaits(g._replace(label=4)) is False
        awaited = [g] if g.is_faint and newcomers.awaits(g) else []
        sure_ones = [] if g.is_faint else [g]
        newcomers.step(look, sure_ones, [*sure_ones, *awaited], NO_PROOF, awaited)

    assert len(newcomers._followed) == min(surely, 1)
    assert bool(newcomers.sure()) == sure


def test_of_two_new_things_that_are_apart_the_nearer_one_is_known() -> None:
    newcomers = Newcomers(CAMERA, CONFIG)
    places = [np.array([x, 0.0, 0.0]) for x in (-0.15, 0.15)]
    for angle in np.linspace(-20.0, 20.0, 10):
        T = look_at_origin(np.radians(angle), 2.0)
        seen = glimpses(ball_detection([(3, place, 0.06) for place in places], T), T, CAMERA)
        look = Look(0, 0, np.empty((0, 0), np.uint8), T, np.empty((0, 3)), NOTHING)
        newcomers.step(look, seen, seen, NO_PROOF)
    # The first views may go to either; what they begin besides stays small.
    both = sorted(newcomers._followed, key=lambda n: -len(n.glimpses))[:2]
    left, right = sorted(both, key=lambda n: float(n.place.center[0]) if n.place else 0.0)

    assert newcomers.has_nearer(right, places[0], CONFIG)
    assert not newcomers.has_nearer(left, places[0], CONFIG)
    over = glimpses(ball_detection([(3, places[1], 0.06)], T), T, CAMERA)
    near = replace(box_object(), points=box_object().points - [-0.1, 0.0, 0.0])
    assert newcomers.are_apart(over, near, pixels_of(near, T)) == []
    aside = replace(box_object(), points=box_object().points - [0.3, 0.0, 0.0])
    assert newcomers.are_apart(over, aside, pixels_of(aside, T)) == over


def test_how_surely_it_is_found_is_told_by_viewpoints_and_not_by_images() -> None:
    newcomer = Newcomer()
    seen_from(newcomer, np.linspace(0.0, 4.0, 30), np.array([0.1, 0.0, 0.0]))
    assert newcomer.hit_rate(CONFIG) < CONFIG.presence.highest_hit_rate

    seen_from(newcomer, np.linspace(4.0, 60.0, 20), np.array([0.1, 0.0, 0.0]))
    assert newcomer.hit_rate(CONFIG) > CONFIG.presence.highest_hit_rate


@pytest.mark.parametrize(("hidden", "as_before"), [(4, True), (40, False)])
def test_few_points_that_show_where_it_is_are_of_what_it_stands_on(
    hidden: int, as_before: bool
) -> None:
    newcomer, T = Newcomer(), look_at_origin(0.0, 2.0)
    (glimpse,) = glimpses(ball_detection([(3, np.zeros(3), 0.1)], T), T, CAMERA)
    n = 3 + hidden
    depth = np.where(np.arange(n) < 3, 1.99, 3.0)
    proof = Proof(
        np.arange(n, dtype=np.int32),
        np.zeros((n, 3)),
        np.full((n, 2), (319.5, 239.5), np.float32),
        depth,
        np.ones(n),
        np.where(np.arange(n) < 3, CONFIRMED, CONTRADICTED).astype(np.int32),
    )
    look = Look(0, 0, np.empty((0, 0), np.uint8), T, np.empty((0, 3)), NOTHING)
    measured = glimpse._replace(distance_m=1.98, distance_sigma_m=0.02)
    for _ in range(3):
        newcomer.add(measured, look, proof)

    assert newcomer.is_as_before(0.2) == as_before


def pixels_of(thing: MapObject, T: Mat4) -> F32:
    return CAMERA.project(se3.transform(se3.inverse(T), thing.points)).astype(np.float32)


def follow(
    newcomers: Newcomers,
    center: np.ndarray,
    angles_deg: np.ndarray,
    radius_m: float = 0.1,
    label: int = 3,
) -> None:
    for i, angle in enumerate(angles_deg):
        T = look_at_origin(np.radians(angle), 2.0)
        seen = glimpses(ball_detection([(label, center, radius_m)], T), T, CAMERA)
        look = Look(i, 10**8 * i, np.empty((0, 0), np.uint8), T, np.empty((0, 3)), NOTHING)
        newcomers.step(look, seen, seen, NO_PROOF)


@pytest.mark.parametrize(("label", "is_new"), [(1, False), (3, True)])
def test_a_mask_of_the_name_of_a_known_thing_is_not_of_a_new_one_before_it(
    label: int, is_new: bool
) -> None:
    newcomers, before_it = Newcomers(CAMERA, CONFIG), np.array([0.0, 0.0, -0.8])
    follow(newcomers, before_it, np.linspace(-20.0, 20.0, 9))
    T = look_at_origin(0.0, 2.0)
    (mask,) = glimpses(ball_detection([(label, before_it, 0.1)], T), T, CAMERA)

    thing = box_object()

    assert (newcomers.are_apart([mask], thing, pixels_of(thing, T)) == [mask]) == is_new


def test_what_proves_to_be_where_one_of_its_kind_was_told_is_that_one() -> None:
    newcomers = Newcomers(CAMERA, CONFIG)
    follow(newcomers, np.zeros(3), np.linspace(-20.0, 20.0, 9))
    (told,) = newcomers.sure()
    same, other = Newcomer(), Newcomer()
    seen_from(same, np.linspace(-20.0, 20.0, 9), np.array([0.04, 0.0, 0.0]))
    seen_from(other, np.linspace(-20.0, 20.0, 9), np.array([0.3, 0.0, 0.0]))
    assert not newcomers.is_told(same)

    told.was_told = True

    assert newcomers.is_told(same)
    assert not newcomers.is_told(other)


@pytest.mark.parametrize(("apart_m", "is_part"), [(0.16, True), (0.3, False)])
def test_what_touches_a_larger_new_thing_in_every_image_is_a_part_of_it(
    apart_m: float, is_part: bool
) -> None:
    newcomers = Newcomers(CAMERA, CONFIG)
    balls = [(3, np.zeros(3), 0.1), (4, np.array([0.0, apart_m, 0.0]), 0.06)]
    for number, angle in enumerate(np.arange(-20.0, 21.0, 10.0)):
        T = look_at_origin(np.radians(angle), 2.0)
        seen = glimpses(ball_detection(balls, T), T, CAMERA)
        look = Look(number, number, np.empty((0, 0), np.uint8), T, np.empty((0, 3)), NOTHING)
        newcomers.step(look, seen, seen, NO_PROOF)
    plant, pot = newcomers._followed

    assert not newcomers.is_part_of_told(pot)
    plant.was_told = True
    assert newcomers.is_part_of_told(pot) == is_part
    assert not newcomers.is_part_of_told(plant)
