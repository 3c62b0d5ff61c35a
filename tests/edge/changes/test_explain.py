# SPDX-License-Identifier: Apache-2.0
"""Masks are of objects of the map by place and size, and by name where those leave it open."""

import dataclasses

import numpy as np
import pytest

from edge.changes.expect import Expectation
from edge.changes.explain import Shown, claims, explains, is_beside, shown_part
from edge.changes.glimpse import Glimpse, glimpses
from edge.changes.known import Known
from edge.config.changes import ChangesConfig
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject
from edge.types import F32, Detections, Mask

CAMERA = CameraModel(320, 240, 200.0, 200.0, 159.5, 119.5, "none", ())
GRID = np.stack(np.meshgrid(np.arange(100.0, 141.0, 5.0), np.arange(80.0, 121.0, 5.0)), axis=-1)
PIXELS: F32 = GRID.reshape(-1, 2).astype(np.float32)  # 40 pixels a side


def known(label: int = 1, company: frozenset[int] = frozenset()) -> Known:
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (40, 3)) + np.array([0.0, 0.0, 2.0])
    thing = MapObject(label, points, np.zeros((3, 3)), np.ones(3, bool))
    return Known(thing, np.empty(0, np.int32), ChangesConfig(), company=company)


def expectation(reason: str = "expected") -> Expectation:
    direction = np.array([0.0, 0.0, -1.0])
    return Expectation(reason, PIXELS, np.ones(len(PIXELS), bool), direction, 0.9)  # type: ignore[arg-type]


def shown() -> Shown:
    part = shown_part(known(), expectation(), CAMERA)
    assert part is not None
    return part


def mask(left: int, top: int, w: int, h: int, label: int = 1) -> Glimpse:
    box = np.array([[left, top, left + w, top + h]], np.float32)
    inside = np.ones((h, w), bool)
    found = Detections(
        box, np.ones(1, np.float32), np.array([label], np.int32), (Mask(left, top, inside),)
    )
    return glimpses(found, np.eye(4), CAMERA)[0]


@pytest.mark.parametrize(
    ("g", "is_of_it"),
    [
        (mask(98, 78, 44, 44), True),
        (mask(98, 78, 44, 44, label=2), True),  # renamed
        (mask(102, 82, 12, 36), True),  # what something before it leaves of it
        (mask(102, 82, 12, 36, label=2), False),  # another thing before it
        (mask(115, 60, 44, 44, label=2), False),  # another thing that hides a part of it
        (mask(145, 80, 40, 40), False),
        (mask(20, 20, 200, 200), False),  # far too large
    ],
)
def test_a_mask_is_of_what_it_covers_and_of_another_name_only_if_it_is_as_large(
    g: Glimpse, is_of_it: bool
) -> None:
    assert explains(shown(), g) is is_of_it


@pytest.mark.parametrize(
    ("names", "is_of_it"), [(None, True), (frozenset({2}), True), (frozenset[int](), False)]
)
def test_what_many_images_never_took_for_another_class_is_not_of_that_now(
    names: frozenset[int] | None, is_of_it: bool
) -> None:
    thing = Known(known().thing, np.empty(0, np.int32), ChangesConfig(), aliases=names)

    renamed = mask(98, 78, 44, 44, label=2)
    assert explains(shown()._replace(known=thing), renamed) == is_of_it
    assert bool(claims(shown()._replace(known=thing), [renamed], []).own) == is_of_it
    assert explains(shown()._replace(known=thing), mask(98, 78, 44, 44))


def test_a_table_under_it_neither_shows_nor_hides_it() -> None:
    table, own, renamed = mask(20, 60, 250, 150, 7), mask(98, 78, 44, 44), mask(98, 78, 44, 44, 2)
    seen = [table, own, renamed]
    before, alone = shown(), shown()._replace(known=known(company=frozenset({7})))

    assert claims(before, seen, []) == ([own.mask, renamed.mask], [table.mask])
    assert claims(alone, seen, []) == ([own.mask, renamed.mask], [])


def test_a_mask_of_another_object_says_nothing() -> None:
    beside = mask(120, 78, 44, 44, 2)
    there = expectation()
    moved = dataclasses.replace(there, pixels=PIXELS + np.float32((20.0, 0.0)))
    other = shown_part(known(2), moved, CAMERA)
    assert other is not None

    assert claims(shown(), [beside], []).unknown == [beside.mask]
    assert claims(shown(), [beside], [other]).unknown == []


@pytest.mark.parametrize(("distance_m", "says_nothing"), [(2.0, False), (2.1, False), (3.0, True)])
def test_what_is_seen_behind_it_says_nothing_of_it(distance_m: float, says_nothing: bool) -> None:
    chair = mask(120, 78, 80, 44, 2)._replace(distance_m=distance_m, distance_sigma_m=0.1)

    assert claims(shown(), [chair], []).unknown == ([] if says_nothing else [chair.mask])


def test_a_mask_of_its_name_next_to_it_may_be_of_it() -> None:
    assert is_beside(shown(), mask(130, 80, 40, 40))
    assert not is_beside(shown(), mask(130, 80, 40, 40, label=2))
    assert not is_beside(shown(), mask(190, 80, 40, 40))


def test_what_the_border_cuts_is_shown_in_part() -> None:
    found = expectation()
    beyond = (PIXELS + np.array([200.0, 0.0])).astype(np.float32)
    beyond[:3] = np.nan  # where the lens sees nothing
    at_border = dataclasses.replace(found, pixels=beyond)
    away = dataclasses.replace(found, pixels=PIXELS + 400.0)

    cut = shown_part(known(), at_border, CAMERA)

    assert cut is not None
    assert np.isfinite(cut.pixels).all()
    assert cut.high.tolist() == [340.0, 120.0]
    assert shown_part(known(), away, CAMERA) is None
