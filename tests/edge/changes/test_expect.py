# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from edge.changes.cover import find_cover
from edge.changes.expect import Surface, expect, sight
from edge.config.changes import PresenceConfig
from edge.geometry.camera import CameraModel
from edge.types import Detections, Mask
from tests.edge.changes.scenes import CAMERA, box_object, detection, look_at_origin

CONFIG = PresenceConfig()
THING = box_object()


def surface(depth_m: float) -> Surface:
    return lambda pixels, _: np.full(len(pixels), depth_m)


UNKNOWN = surface(np.nan)


def test_an_object_in_plain_view_is_expected_where_it_is() -> None:
    found = expect(THING, look_at_origin(0.0, 1.5), CAMERA, UNKNOWN, CONFIG)

    assert found.holds
    assert found.visible.all()
    np.testing.assert_allclose(found.direction, [0.0, 0.0, -1.0], atol=1e-12)
    near_face = 420.0 * 0.1 / 1.4
    assert found.pixels[:, 0].min() == pytest.approx(319.5 - near_face, abs=1e-3)
    assert found.pixels[:, 1].max() == pytest.approx(239.5 + near_face, abs=1e-3)


def test_what_it_is_not_expected_for_is_said() -> None:
    aside = look_at_origin(0.0, 1.5)
    aside[0, 3] += 2.0
    behind = look_at_origin(0.0, 1.5)
    behind[:3, :3] = behind[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    small = CameraModel(64, 48, 12.0, 12.0, 31.5, 23.5)

    assert expect(THING, aside, CAMERA, UNKNOWN, CONFIG).reason == "outside"
    assert expect(THING, behind, CAMERA, UNKNOWN, CONFIG).reason == "outside"
    assert expect(THING, look_at_origin(0.0, 1.5), small, UNKNOWN, CONFIG).reason == "small"
    assert expect(THING, look_at_origin(0.0, 2.7), CAMERA, UNKNOWN, CONFIG).reason == "far"
    assert expect(THING, look_at_origin(0.8, 1.5), CAMERA, UNKNOWN, CONFIG).reason == "other side"
    assert expect(THING, look_at_origin(0.6, 1.5), CAMERA, UNKNOWN, CONFIG).holds


def test_what_the_model_merely_guessed_is_found_again_less_often() -> None:
    guessed = replace(THING, chance=np.array([0.5]))
    T = look_at_origin(0.0, 1.5)

    assert expect(THING, T, CAMERA, UNKNOWN, CONFIG).hit_rate == 1.0
    assert expect(guessed, T, CAMERA, UNKNOWN, CONFIG).hit_rate == 0.5


def test_what_stands_before_it_hides_it_and_what_lies_behind_does_not() -> None:
    T = look_at_origin(0.0, 1.5)
    half = np.where(THING.points[:, 0] < 0.02, 1.0, np.nan)

    assert expect(THING, T, CAMERA, surface(1.0), CONFIG).reason == "hidden"
    assert expect(THING, T, CAMERA, lambda *_: half, CONFIG).reason == "hidden"
    assert expect(THING, T, CAMERA, surface(3.0), CONFIG).holds
    # Its own surface, measured with some error.
    assert expect(THING, T, CAMERA, surface(1.48), CONFIG).holds


def test_a_lens_moves_the_pixels_as_it_moves_the_image() -> None:
    lens = CameraModel(640, 480, 420.0, 420.0, 319.5, 239.5, "radtan", (-0.3, 0.1, 0.0, 0.0))
    T = look_at_origin(0.0, 1.5)
    T[0, 3] -= 0.6

    straight = expect(THING, T, CAMERA, UNKNOWN, CONFIG)
    bent = expect(THING, T, lens, UNKNOWN, CONFIG)

    expected = lens.distort_pixels(straight.pixels.astype(np.float64))
    np.testing.assert_allclose(bent.pixels, expected, atol=1e-2)
    assert abs(bent.pixels - straight.pixels).max() > 5.0


def test_it_is_seen_under_a_mask_and_missed_where_none_lies() -> None:
    found = expect(THING, look_at_origin(0.0, 1.5), CAMERA, UNKNOWN, CONFIG)
    over, part = detection(285, 205, 355, 275).masks, detection(285, 205, 310, 275).masks

    assert sight(found, over, (), CONFIG) == "seen"
    assert sight(found, (), (), CONFIG) == "missed"
    assert sight(found, detection(0, 0, 200, 200).masks, (), CONFIG) == "missed"
    assert sight(found, part, (), CONFIG) == "unclear"
    assert sight(found, (), over, CONFIG) == "unclear"  # what nobody knows may hide it


def test_the_better_of_two_masks_owns_a_pixel() -> None:
    both = np.ones((4, 4), dtype=bool)
    hole = both.copy()
    hole[1, 1] = False
    seen = Detections(
        np.zeros((2, 4), np.float32),
        np.array([0.9, 0.5], np.float32),
        np.array([3, 4], np.int32),
        (Mask(10, 20, hole), Mask(11, 21, both)),
    )
    pixels = np.array([[10, 20], [11, 21], [12.4, 21.6], [14, 24], [9, 20], [15, 25]], np.float32)

    assert find_cover(seen, pixels).tolist() == [0, 1, 0, 1, -1, -1]


def test_another_mask_beside_it_does_not_hide_that_it_is_seen() -> None:
    found = expect(THING, look_at_origin(0.0, 1.5), CAMERA, UNKNOWN, CONFIG)
    there, elsewhere = detection(285, 205, 355, 275), detection(0, 0, 200, 200)

    assert sight(found, elsewhere.masks + there.masks, elsewhere.masks, CONFIG) == "seen"
