# SPDX-License-Identifier: Apache-2.0
"""What a mask holds beside an object of the map is told apart from the object's own border."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from edge.changes.explain import explains
from edge.changes.glimpse import Glimpse, glimpses, unknown_range
from edge.changes.rest import rests
from edge.types import Detections, Mask
from tests.edge.changes.test_explain import CAMERA, mask, shown

# The object takes the pixels 100 to 140, 80 to 120.


def found(inside: Mask, label: int = 1) -> Glimpse:
    h, w = inside.inside.shape
    box = np.array([[inside.left, inside.top, inside.left + w, inside.top + h]], np.float32)
    scores, classes = np.array([0.7], np.float32), np.array([label], np.int32)
    return glimpses(Detections(box, scores, classes, (inside,)), np.eye(4), CAMERA)[0]


@pytest.mark.parametrize(("left", "beside"), [(100, (144, 181)), (60, (60, 97))])
def test_of_two_things_under_one_mask_the_new_one_is_left(
    left: int, beside: tuple[int, int]
) -> None:
    both = mask(left, 80, 81, 41)

    (rest,) = rests([both], [shown()], unknown_range)

    columns = rest.mask.left + np.flatnonzero(rest.mask.inside.any(axis=0))
    # Errors of poses and masks are left out, and no more: four pixels for this one.
    assert columns[0] == pytest.approx(beside[0], abs=2)
    assert columns[-1] + 1 == pytest.approx(beside[1], abs=2)
    assert rest.mask.inside.all()
    assert (rest.mask.top, rest.mask.inside.shape[0]) == (80, 41)
    assert (rest.label, rest.score) == (both.label, both.score)


@pytest.mark.parametrize(
    "one",
    [
        mask(100, 80, 41, 41),
        mask(92, 72, 57, 57),  # a model that draws a wide border
        mask(100, 80, 55, 41),  # on one side
        mask(98, 78, 44, 44, label=2),  # renamed
        mask(100, 80, 41, 120, label=2),  # of another class
        mask(160, 80, 41, 41),  # beside: nothing explains it
    ],
)
def test_an_object_alone_leaves_nothing(one: Glimpse) -> None:
    assert list(rests([one], [shown()], unknown_range)) == []


def test_a_new_thing_among_objects_of_the_map_is_beside_all_of_them() -> None:
    first = shown()
    pixels = first.pixels + np.array([80.0, 0.0], np.float32)
    second = first._replace(pixels=pixels, low=pixels.min(axis=0), high=pixels.max(axis=0))
    inside = np.ones((41, 121), bool)

    (one,) = rests([found(Mask(100, 80, inside))], [first], unknown_range)
    (rest,) = rests([found(Mask(100, 80, inside))], [first, second], unknown_range)

    assert one.mask.inside.shape[1] == pytest.approx(77, abs=2)
    assert rest.mask.inside.shape[1] == pytest.approx(33, abs=4)
    assert rest.mask.left == one.mask.left


def test_of_what_the_map_seldom_found_nobody_knows_where_it_ends() -> None:
    part, both = shown(), mask(100, 80, 81, 41)
    rarely = replace(part.known.thing, found=np.array([True, True, False]))
    part.known.thing = rarely

    assert list(rests([both], [part], unknown_range)) == []


def test_what_has_gone_takes_nothing_from_a_mask() -> None:
    gone = shown()
    both = mask(100, 80, 81, 41)
    assert list(rests([both], [gone], unknown_range))

    gone.known.was_told = True

    assert list(rests([both], [gone], unknown_range)) == []


def test_places_far_beside_the_image_do_no_harm() -> None:
    first = shown()
    pixels = first.pixels.copy()
    pixels[0] = (-1e12, 1e12)

    assert list(rests([mask(98, 78, 44, 44)], [first._replace(pixels=pixels)], unknown_range)) == []


def test_beside_an_object_larger_than_the_mask_nothing_is_looked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = shown()
    middle = np.array([120.0, 100.0], np.float32)
    pixels = middle + 200 * (first.pixels - middle)
    near = first._replace(pixels=pixels, low=pixels.min(axis=0), high=pixels.max(axis=0))
    one = mask(-300, -300, 640, 480)
    assert explains(near, one)

    def opened(*_: object) -> None:
        pytest.fail("looked for")

    monkeypatch.setattr(cv2, "morphologyEx", opened)

    assert list(rests([one], [near], unknown_range)) == []
