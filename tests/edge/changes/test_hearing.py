# SPDX-License-Identifier: Apache-2.0
"""Masks and points of a box that may have gone."""

import numpy as np
import pytest

from edge.changes.expect import Expectation, Sighting
from edge.changes.hearing import hear
from edge.changes.known import Known
from edge.changes.proof import CONFIRMED, CONTRADICTED, Proof
from edge.config.changes import ChangesConfig
from edge.geometry import se3
from edge.types import I32, Look
from maps.labels.portraits import portray
from tests.edge.changes.plate_scene import PLATE, around, draw, plate_object
from tests.edge.changes.scenes import CAMERA, HALF_M, NOTHING, box_object, look_at_origin

CONFIG = ChangesConfig()
FRONT = np.array([[x, y, -HALF_M] for x in (-0.05, 0.0, 0.05) for y in (-0.05, 0.05)])


def told(
    sighting: Sighting, hit_rate: float, verdict: list[int], visible_share: float = 1.0
) -> Known:
    """The box after a look from each of five viewpoints that all say the same."""
    points = np.arange(len(FRONT), dtype=np.int32)
    known = Known(box_object(), points, CONFIG)
    for i in range(5):
        T = look_at_origin(np.radians(-10.0 + 5.0 * i), 2.0)
        pixels = CAMERA.project(se3.transform(se3.inverse(T), known.thing.points))
        visible = np.arange(len(pixels)) < visible_share * len(pixels)
        found = Expectation("expected", pixels.astype(np.float32), visible, T[:3, 2], hit_rate)
        look = Look(i, i, np.empty((0, 0), np.uint8), T, np.empty((0, 3)), NOTHING)
        hear(known, found, look, proof(T, np.array(verdict, np.int32)), sighting, CAMERA)
    return known


def proof(T: np.ndarray, verdict: I32) -> Proof:
    local = se3.transform(se3.inverse(T), FRONT)
    pixels = CAMERA.project(local).astype(np.float32)
    numbers = np.arange(len(FRONT), dtype=np.int32)
    return Proof(numbers, FRONT, pixels, local[:, 2], np.full(len(FRONT), 4.0), verdict)


@pytest.mark.parametrize(("n_other", "gone"), [(0, False), (3, False), (6, True)])
def test_what_a_model_rarely_finds_has_gone_where_its_points_show_something_else(
    n_other: int, gone: bool
) -> None:
    known = told("missed", 0.1, [CONTRADICTED] * n_other + [0] * (6 - n_other))

    assert known.is_gone == gone
    if n_other == 0:
        assert known.presence.n_against == 0


def test_what_is_hidden_in_part_is_missed_with_less_weight() -> None:
    whole, part = (told("missed", 0.9, [0] * 6, share).presence for share in (1.0, 0.6))

    assert whole.log_odds < part.log_odds < 2.0


def test_a_mask_over_points_that_show_something_else_is_of_that() -> None:
    other = told("seen", 0.9, [CONTRADICTED] * 6)
    assert (other.presence.n_for, other.presence.n_against) == (0, 0)

    assert told("seen", 0.9, [CONTRADICTED] * 4 + [CONFIRMED] * 2).presence.n_for == 5
    assert told("seen", 0.9, [0] * 6).presence.n_for == 5


@pytest.mark.parametrize(("shown", "n_for"), [(PLATE, 5), (None, 0)])
def test_what_looks_as_it_did_is_there_though_the_model_blinks(
    shown: int | None, n_for: int
) -> None:
    poses = around([-10.0, -5.0, 0.0, 5.0, 10.0])
    images = [draw(CAMERA, T, PLATE, (0.0, 0.0)) for T in poses]
    (thing,) = portray([plate_object(poses)], poses, [CAMERA] * 5, lambda k: images[k])
    known = Known(thing, np.empty(0, np.int32), CONFIG)
    for i, T in enumerate(around([-12.0, -6.0, 0.0, 6.0, 12.0], 1.5)):
        pixels = CAMERA.project(se3.transform(se3.inverse(T), thing.points)).astype(np.float32)
        found = Expectation("expected", pixels, np.ones(len(pixels), bool), -T[:3, 2], 0.9)
        image = draw(CAMERA, T, shown, (0.0, 0.0))
        look = Look(i, i, image, T, np.empty((0, 3)), NOTHING)
        hear(known, found, look, proof(T, np.zeros(6, np.int32)), "missed", CAMERA)

    assert known.presence.n_for == n_for
    assert known.is_gone == (shown is None)
