# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import Frame
from tools.bench.localisation_curve import Answer, curve, spoilt
from tools.bench.localisation_same import SAME_SHARE, SameSurface
from tools.bench.localisation_setups import other_camera, seen_by
from tools.simworld.paths import make_path
from tools.simworld.rooms import make_room


def answer(found: bool, right: bool, inliers: int, *, findable: bool = True) -> Answer:
    return Answer("plain", findable, found, right, inliers, 0.01)


def test_a_curve_counts_the_worthiest_first() -> None:
    said = [
        answer(True, True, 90),
        answer(True, False, 40, findable=False),
        answer(True, True, 60),
        answer(False, False, 0),
        answer(True, True, 20),
    ]
    recall, precision = curve(said, lambda a: a.inliers)
    assert recall == pytest.approx([0.25, 0.5, 0.5, 0.75])
    assert precision == pytest.approx([1.0, 1.0, 2 / 3, 0.75])


def test_images_are_spoilt_but_keep_their_size() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (120, 160), np.uint8)
    made = dict(spoilt(image, rng))
    assert {(i.shape, i.dtype.str) for i in made.values()} == {((120, 160), "|u1")}
    assert made["dark"].mean() < 0.2 * image.mean()
    assert np.mean(made["most covered"] == image) < 0.35


def test_another_camera_sees_the_same_points_where_it_says() -> None:
    camera = CameraModel(320, 240, 250.0, 250.0, 160.0, 120.0)
    other = other_camera(camera)
    v, u = np.mgrid[:240, :320].astype(np.float64)
    blobs = np.array([[0.1, -0.05], [-0.2, 0.15], [0.0, 0.0]])  # on the normalised plane
    image = np.zeros((240, 320))
    for x, y in camera.denormalise(blobs):
        image += 250.0 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 18.0)
    (seen,) = seen_by([Frame(0, 0, image.astype(np.uint8))], camera, other)
    assert seen.image.shape == (other.height, other.width)
    for x, y in other.denormalise(other.distort(blobs)):
        near = seen.image[int(y) - 8 : int(y) + 9, int(x) - 8 : int(x) + 9].astype(np.float64)
        rows, columns = np.mgrid[int(y) - 8 : int(y) + 9, int(x) - 8 : int(x) + 9]
        centre = (np.sum(near * columns), np.sum(near * rows)) / near.sum()
        np.testing.assert_allclose(centre, (x, y), atol=0.3)


def test_what_stands_the_same_in_two_rooms_is_told_from_what_does_not() -> None:
    camera = CameraModel(96, 72, 80.0, 80.0, 47.5, 35.5)
    pixels = np.random.default_rng(0).uniform((2, 2), (93, 69), (200, 2)).astype(np.float32)
    room = make_room(3)
    furnished = len(room.things) // 2
    emptier = dataclasses.replace(room, things=room.things[:furnished])
    T = make_path(room, 1, 4.0).T_world_cam[0]
    aside = se3.exp([0.06, 0.0, 0.0, 0.0, 0.0, 0.0]) @ T
    elsewhere = se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.8]) @ T
    same, other = SameSurface(room, room, camera), SameSurface(room, emptier, camera)
    assert same.share(T, T, pixels) == 1.0
    assert 0.1 < other.share(T, T, pixels) < 0.95
    assert same.share(T, aside, pixels) < SAME_SHARE
    assert same.share(T, elsewhere, pixels) < 0.1
