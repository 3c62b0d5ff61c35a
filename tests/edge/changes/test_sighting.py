# SPDX-License-Identifier: Apache-2.0
"""Objects of the map among new things."""

from dataclasses import replace

import numpy as np
import pytest

from edge.changes.expect import expect
from edge.changes.explain import shown_part
from edge.changes.glimpse import glimpses
from edge.changes.known import Known
from edge.changes.newcomers import Newcomers
from edge.changes.sighting import sighting_of
from edge.config.changes import ChangesConfig
from edge.types import F64
from tests.edge.changes.scenes import (
    CAMERA,
    ball_detection,
    box_object,
    joined,
    look_at_origin,
)
from tests.edge.changes.test_newcomers import follow

CONFIG = ChangesConfig()
BEFORE_IT = np.array([-0.08, 0.0, -0.16])
DISTANCE_M = 1.0


def nothing_before(pixels: F64, _depth_m: F64) -> F64:
    return np.full(len(pixels), np.nan)


@pytest.mark.parametrize(
    ("was_told", "is_there", "said"),
    [(False, False, "unclear"), (True, False, "missed"), (True, True, "seen")],
)
def test_a_new_thing_hides_what_it_covers_and_no_more(
    was_told: bool, is_there: bool, said: str
) -> None:
    newcomers = Newcomers(CAMERA, CONFIG)
    follow(newcomers, BEFORE_IT, np.linspace(-20.0, 20.0, 9), radius_m=0.05)
    newcomers.sure()[0].was_told = was_told
    T, thing = look_at_origin(0.0, DISTANCE_M), box_object()
    found = expect(thing, T, CAMERA, nothing_before, CONFIG.presence)
    part = shown_part(Known(thing, np.empty(0, np.int32), CONFIG), found, CAMERA)
    assert part is not None
    balls = [(3, BEFORE_IT, 0.05)] + [(thing.label, np.zeros(3), 0.12)] * is_there
    seen = glimpses(ball_detection(balls, T), T, CAMERA)

    assert sighting_of(part, seen, [], newcomers, CONFIG.presence)[0] == said


@pytest.mark.parametrize(("holds_both", "said"), [(False, "missed"), (True, "seen")])
def test_a_mask_over_a_thing_and_a_new_one_beside_it_does_not_say_that_it_has_gone(
    holds_both: bool, said: str
) -> None:
    thing, beside = box_object(), np.array([0.37, 0.0, 0.0])
    newcomers = Newcomers(CAMERA, CONFIG)
    follow(newcomers, beside, np.linspace(-20.0, 20.0, 9), 0.15, thing.label)
    T = look_at_origin(0.0, DISTANCE_M)
    found = expect(thing, T, CAMERA, nothing_before, CONFIG.presence)
    part = shown_part(Known(thing, np.empty(0, np.int32), CONFIG), found, CAMERA)
    assert part is not None
    balls = [(thing.label, beside, 0.15)] + [(thing.label, np.zeros(3), 0.12)] * holds_both
    seen = glimpses(joined(ball_detection(balls, T)), T, CAMERA)
    assert newcomers.explain(seen[0], thing)

    assert sighting_of(part, seen, [], newcomers, CONFIG.presence)[0] == said


@pytest.mark.parametrize(("away_m", "said"), [(-0.3, "unclear"), (0.4, "missed")])
def test_a_mask_of_what_is_known_to_stand_before_it_hides_it(away_m: float, said: str) -> None:
    T, thing = look_at_origin(0.0, DISTANCE_M), box_object()
    place = np.array([0.0, 0.0, away_m])
    other = replace(thing, label=3, points=2.5 * thing.points + place)
    parts = []
    for one in (thing, other):
        found = expect(one, T, CAMERA, nothing_before, CONFIG.presence)
        part = shown_part(Known(one, np.empty(0, np.int32), CONFIG), found, CAMERA)
        assert part is not None
        parts.append(part)
    seen = glimpses(ball_detection([(3, place, 0.3)], T), T, CAMERA)

    new = Newcomers(CAMERA, CONFIG)
    sighting, shows = sighting_of(parts[0], seen, parts[1:], new, CONFIG.presence)
    assert sighting == said
    assert (shows.visible.sum() < parts[0].found.visible.sum()) == (said == "unclear")
