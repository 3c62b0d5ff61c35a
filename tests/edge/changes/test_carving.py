# SPDX-License-Identifier: Apache-2.0
"""A box of the map with another of its kind behind it: one mask over both, as models draw them."""

import numpy as np
import pytest

from edge.changes.carving import Carving
from edge.changes.expect import expect
from edge.changes.explain import shown_part
from edge.changes.glimpse import glimpses
from edge.changes.hearing import lay_bare
from edge.changes.known import Known
from edge.config.changes import ChangesConfig
from edge.geometry import se3
from edge.types import F64, Bools, Detections, Look, Mask, Mat4
from tests.edge.changes.scenes import CAMERA, HALF_M, box_object, look_at_origin

CONFIG = ChangesConfig()
BEHIND = np.array([0.0, 0.0, 8.0 * HALF_M])
DISTANCE_M = 1.5
NO_IMAGE, NO_SURFACE = np.zeros((1, 1), np.uint8), np.empty((0, 3))


def nothing_before(pixels: F64, _depth_m: F64) -> F64:
    return np.full(len(pixels), np.nan)


def inside_of(T: Mat4, *centers: F64) -> Bools:
    """Pixels (h, w) of boxes like the known one."""
    inside = np.zeros((CAMERA.height, CAMERA.width), bool)
    for center in centers:
        local = se3.transform(se3.inverse(T), 1.1 * box_object().points + center)
        column, row = np.rint(CAMERA.project(local)).astype(int).T
        inside[row.min() : row.max() + 1, column.min() : column.max() + 1] = True
    return inside


def seen(T: Mat4, label: int, *centers: F64) -> Detections:
    one = Mask(0, 0, inside_of(T, *centers))
    box = np.array([[0, 0, CAMERA.width, CAMERA.height]], np.float32)
    return Detections(box, np.ones(1, np.float32), np.array([label], np.int32), (one,))


def after(angles_deg: F64, label: int, *centers: F64) -> Known:
    """The box after images that show boxes at these places under one mask."""
    known = Known(box_object(), np.empty(0, np.int32), CONFIG)
    for angle in np.radians(angles_deg):
        T = look_at_origin(float(angle), DISTANCE_M)
        found = expect(known.expected, T, CAMERA, nothing_before, CONFIG.presence)
        part = shown_part(known, found, CAMERA)
        assert part is not None
        look = Look(0, 0, NO_IMAGE, T, NO_SURFACE, None)
        masks = glimpses(seen(T, label, *centers), T, CAMERA)
        lay_bare(part, found, look, masks, CONFIG.free_view_deg)
    return known


AROUND = np.linspace(-38.0, 38.0, 25)


def test_another_behind_it_cannot_stand_for_it_from_everywhere() -> None:
    assert after(AROUND, 1, np.zeros(3), BEHIND).carving.bare_share == 0.0
    assert not after(AROUND, 1, np.zeros(3), BEHIND).is_gone

    gone = after(AROUND, 1, BEHIND)

    assert gone.carving.bare_share > 0.6
    assert gone.is_gone


@pytest.mark.parametrize("kind", ["one place", "another kind", "patches far apart"])
def test_one_place_things_of_another_kind_and_patches_tell_nothing(kind: str) -> None:
    angles = np.full(25, 35.0) if kind == "one place" else AROUND
    also = [BEHIND + np.array([6.0, 6.0, 0.0]) * HALF_M] * (kind == "patches far apart")

    assert not after(angles, 3 if kind == "another kind" else 1, BEHIND, *also).is_gone


def test_what_the_map_often_missed_is_not_carved_away() -> None:
    known = after(AROUND, 1, BEHIND)
    rarely = box_object()
    known.thing = type(rarely)(1, rarely.points, rarely.cameras, np.array([True, False]))

    assert not known.is_carved_away


def test_viewpoints_count_and_not_images() -> None:
    carving, every = Carving(2), np.ones(2, bool)
    for _ in range(200):
        carving.add(0, every, np.array([True, False]))
    carving.add(1, every, np.array([False, True]))
    carving.add(2, every, np.array([False, True]))
    assert carving.n_viewpoints == 3
    assert carving.bare_share == 0.5
    carving.add(3, np.array([True, False]), ~every)

    assert carving.bare_share == 0.5


def test_what_went_after_a_long_time_is_bare_as_soon_as_what_went_before() -> None:
    carving, every = Carving(3), np.ones(3, bool)
    for viewpoint in range(5000):
        carving.add(viewpoint, every, every)
    for viewpoint in range(5000, 5500):
        carving.add(viewpoint, every, np.array([True, False, False]))

    assert carving.bare_share == pytest.approx(2.0 / 3.0)
    assert carving.n_viewpoints < 500
