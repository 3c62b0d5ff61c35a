# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from edge.changes.known import Known, is_part_of, shares_place
from edge.changes.proof import CONFIRMED, CONTRADICTED
from edge.config.changes import ChangesConfig
from tests.edge.changes.scenes import box_object, look_at_origin

CONFIG = ChangesConfig()
DISTANCE_M = 2.0


def miss(known: Known, viewpoints: int) -> None:
    for i in range(viewpoints):
        origin = look_at_origin(np.radians(20.0 + 10.0 * i), DISTANCE_M)[:3, 3]
        for _ in range(3):
            known.presence.add("missed", origin, DISTANCE_M, 0.9)


@pytest.mark.parametrize("was_seen", [False, True])
def test_a_plain_thing_that_was_seen_meanwhile_is_gone_only_if_missed_twice_as_often(
    was_seen: bool,
) -> None:
    known = Known(box_object(), np.empty(0, np.int32), CONFIG)
    if was_seen:
        origin = look_at_origin(0.0, DISTANCE_M)[:3, 3]
        known.presence.add("seen", origin, DISTANCE_M, 0.9)

    miss(known, 4)
    assert known.presence.is_gone
    assert known.is_gone != was_seen

    miss(known, 7)
    assert known.is_gone


@pytest.mark.parametrize(("n_unclear", "is_gone"), [(0, True), (3, True), (4, False)])
def test_a_plain_thing_that_is_mostly_unclear_is_gone_only_if_missed_twice_as_often(
    n_unclear: int, is_gone: bool
) -> None:
    known = Known(box_object(), np.empty(0, np.int32), CONFIG)
    for i in range(n_unclear):
        origin = look_at_origin(np.radians(-20.0 - 10.0 * i), DISTANCE_M)[:3, 3]
        known.presence.add("unclear", origin, DISTANCE_M, 0.9)

    miss(known, 4)
    assert known.presence.is_gone
    assert known.is_gone == is_gone

    miss(known, 8)
    assert known.is_gone


@pytest.mark.parametrize("unclear", [1, 2, 3])
def test_viewpoints_that_now_miss_a_plain_thing_and_now_cannot_tell_do_not_tell(
    unclear: int,
) -> None:
    known = Known(box_object(), np.empty(0, np.int32), CONFIG)
    miss(known, 4)
    for i in range(4):
        origin = look_at_origin(np.radians(20.0 + 10.0 * i), DISTANCE_M)[:3, 3]
        for _ in range(unclear):
            known.presence.add("unclear", origin, DISTANCE_M, 0.9)

    assert known.presence.is_gone
    assert known.is_gone == (unclear < 3)  # of as many images that miss it


@pytest.mark.parametrize(
    ("n_found", "verdict", "is_gone"),
    [
        (9, None, True),
        (6, None, False),
        (6, CONFIRMED, False),
        (6, CONTRADICTED, True),
    ],
)
def test_points_must_tell_of_what_the_model_often_failed_to_find(
    n_found: int, verdict: int | None, is_gone: bool
) -> None:
    thing = box_object()
    found = np.arange(10) < n_found
    thing = replace(thing, cameras=np.repeat(thing.cameras, 10, axis=0), found=found)
    known = Known(thing, np.arange(8, dtype=np.int32), CONFIG)
    miss(known, 8)
    for _ in range(2 * (verdict is not None)):
        known.hear_points(known.points, np.full(8, verdict, np.int32))

    assert known.presence.is_gone
    assert known.is_gone == is_gone


@pytest.mark.parametrize("verdict", [None, CONFIRMED])
def test_points_that_no_image_could_test_keep_nothing_in_the_map(verdict: int | None) -> None:
    points = np.arange(8, dtype=np.int32)
    known = Known(box_object(), points, CONFIG)
    miss(known, 4)
    if verdict is not None:
        known.hear_points(points[:1], np.array([verdict], np.int32))

    assert known.is_gone == (verdict is None)


@pytest.mark.parametrize("told", [1, 2])
def test_two_points_that_show_something_else_are_enough_where_no_more_can_be_tested(
    told: int,
) -> None:
    points = np.arange(8, dtype=np.int32)
    known = Known(box_object(), points, CONFIG)
    miss(known, 4)
    known.hear_points(points[:told], np.full(told, CONTRADICTED, np.int32))

    assert known.is_gone == (told == 2)


@pytest.mark.parametrize("times", [1, 2])
def test_points_that_again_and_again_show_something_else_say_half_of_what_a_viewpoint_does(
    times: int,
) -> None:
    points = np.arange(8, dtype=np.int32)
    known = Known(box_object(), points, CONFIG)
    for i in range(3):
        origin = look_at_origin(np.radians(20.0 + 10.0 * i), DISTANCE_M)[:3, 3]
        for _ in range(3):
            known.presence.add("missed", origin, DISTANCE_M, 0.6)
    for _ in range(times):
        known.hear_points(points, np.full(8, CONTRADICTED, np.int32))

    assert not known.presence.is_gone
    assert known.is_gone == (times == 2)


def test_what_a_model_takes_now_for_this_now_for_that_is_found_by_either() -> None:
    cameras = np.stack([look_at_origin(0.1 * i, DISTANCE_M)[:3, 3] for i in range(10)])
    by_one = np.arange(10) % 3 == 0
    one = replace(box_object(), cameras=cameras, found=by_one)
    # Its images lie in another tile, rounded otherwise; the last one must not have shown it.
    other = replace(one, cameras=cameras[:9] + 1e-6, found=~by_one[:9])

    known = Known(one, np.empty(0, np.int32), CONFIG, [other])

    assert known.expected.found.tolist() == [True] * 10
    assert known.usual is other
    assert Known(one, np.empty(0, np.int32), CONFIG).expected.found.tolist() == by_one.tolist()


@pytest.mark.parametrize(
    ("aside_m", "scale", "company", "is_one"),
    [
        (0.02, 1.0, frozenset[int](), True),  # under two names
        (0.15, 1.0, frozenset[int](), False),
        (0.15, 1.0, frozenset({1}), True),  # a mask of the one held the other
        (0.0, 0.2, frozenset({1}), False),  # what stands on a table goes without it
    ],
)
def test_one_thing_under_two_names_is_told_from_two_things(
    aside_m: float, scale: float, company: frozenset[int], is_one: bool
) -> None:
    thing = box_object()
    other = replace(thing, label=2, points=scale * thing.points + (aside_m, 0.0, 0.0))
    none = np.empty(0, np.int32)

    first, second = Known(thing, none, CONFIG), Known(other, none, CONFIG, company=company)

    assert shares_place(first, second) == is_one
    assert shares_place(second, first) == is_one


@pytest.mark.parametrize(
    ("label", "scale", "aside_m", "is_part"),
    [
        (1, 0.3, 0.14, True),
        (2, 0.3, 0.14, False),  # a pen on a book
        (1, 0.6, 0.14, False),  # a small cup beside a large one
        (1, 0.3, 0.2, False),
    ],
)
def test_a_far_smaller_piece_at_a_thing_of_its_kind_is_a_part_of_it(
    label: int, scale: float, aside_m: float, is_part: bool
) -> None:
    thing = box_object()
    piece = replace(thing, label=label, points=scale * thing.points + (aside_m, 0.0, 0.0))

    assert is_part_of(piece, thing) == is_part
    assert not is_part_of(thing, piece)
