# SPDX-License-Identifier: Apache-2.0
"""Nothing that shows is left out, and most of what lies elsewhere is."""

import numpy as np
import pytest

from edge.changes.in_view import InView
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject

PLAIN = CameraModel(424, 320, 278.0, 278.0, 211.5, 159.5)
RADTAN = CameraModel(424, 320, 278.0, 278.0, 211.5, 159.5, "radtan", (-0.3, 0.1, 0.001, 0.0))
FISHEYE = CameraModel(424, 320, 150.0, 150.0, 211.5, 159.5, "equidistant", (0.01, 0.0, 0.0, 0.0))


def things(rng: np.random.Generator, n: int) -> list[MapObject]:
    found = []
    for center in rng.uniform(-3.0, 3.0, (n, 3)):
        points = center + rng.uniform(-0.3, 0.3, (20, 3))
        found.append(MapObject(0, points, center[None] + 1.0, np.ones(1, bool)))
    return found


@pytest.mark.parametrize("camera", [PLAIN, RADTAN, FISHEYE], ids=["plain", "radtan", "fisheye"])
def test_what_shows_in_part_is_found_and_most_else_is_not(camera: CameraModel) -> None:
    rng = np.random.default_rng(4)
    known = things(rng, 60)
    view = InView(known, camera)
    limit = np.array([camera.width, camera.height]) - 1.0
    n_found = n_shown = 0
    for _ in range(20):
        T_map_cam = se3.exp(rng.normal(0.0, 1.0, 6))
        found = view.of(T_map_cam)
        shown = []
        for i, thing in enumerate(known):
            pixels = camera.project(se3.transform(se3.inverse(T_map_cam), thing.points))
            if ((pixels >= 0.0) & (pixels <= limit)).all(axis=1).any():
                shown.append(i)
        assert set(shown) <= set(found)
        assert found == sorted(found)
        n_found, n_shown = n_found + len(found), n_shown + len(shown)
    assert n_shown > 50
    assert n_found < 3 * n_shown


def test_a_map_without_objects_shows_none() -> None:
    assert InView([], PLAIN).of(np.eye(4)) == []
