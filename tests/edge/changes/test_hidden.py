# SPDX-License-Identifier: Apache-2.0
"""A box that images of the map show from the left, and cannot show from the right."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from edge.changes.hidden import MapViews
from edge.changes.known import Known
from edge.config.changes import ChangesConfig
from edge.tiles.labels import MapObject
from edge.tiles.reader import Map
from tests.edge.changes.scenes import CAMERA, box_object, look_at_origin

CONFIG = ChangesConfig()
LEFT, RIGHT = np.linspace(-30.0, -10.0, 5), np.linspace(10.0, 30.0, 5)


def views(
    distance_right_m: float = 2.0, *, looked_right: bool = True, found_right: bool | None = None
) -> MapViews:
    """Of a map with images from both sides, of which those from the left show the box.

    Whether those from the right were `looked_right` at, and `found_right` a twin, if it has one.
    """
    left = [look_at_origin(np.radians(a), 2.0) for a in LEFT]
    right = [look_at_origin(np.radians(a), distance_right_m) for a in RIGHT]
    T = np.stack([*left, *right])
    thing = MapObject(1, box_object().points, T[:5, :3, 3], np.ones(5, bool))
    map_ = SimpleNamespace(
        T_map_cam=T,
        cameras=(CAMERA,),
        keyframe_camera=np.zeros(len(T), np.uint8),
        pose=T.__getitem__,
    )
    looked_at = np.repeat((True, looked_right), 5)
    twin = MapObject(1, thing.points, T[5:, :3, 3], np.full(5, found_right, bool))
    twins = [] if found_right is None else [twin]
    known = Known(thing, np.empty(0, np.int32), CONFIG, twins)
    return MapViews(known, cast("Map", map_), looked_at, CONFIG.presence)


@pytest.mark.parametrize(("angle_deg", "hidden"), [(-20.0, False), (20.0, True)])
def test_it_is_hidden_where_the_nearest_images_did_not_show_it(
    angle_deg: float, hidden: bool
) -> None:
    origin = look_at_origin(np.radians(angle_deg), 1.8)[:3, 3]

    assert views().was_hidden_from(origin) == hidden


def test_images_from_too_far_away_tell_nothing_of_what_is_before_it() -> None:
    origin = look_at_origin(np.radians(20.0), 1.8)[:3, 3]

    assert not views(distance_right_m=60.0).was_hidden_from(origin)


def test_images_that_no_model_was_shown_tell_nothing_either() -> None:
    origin = look_at_origin(np.radians(20.0), 1.8)[:3, 3]

    assert not views(looked_right=False).was_hidden_from(origin)


@pytest.mark.parametrize("found", [False, True])
def test_images_that_found_it_under_another_mask_showed_it(found: bool) -> None:
    origin = look_at_origin(np.radians(20.0), 1.8)[:3, 3]

    assert views(found_right=found).was_hidden_from(origin) != found
