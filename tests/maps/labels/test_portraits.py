# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject
from edge.types import U8, Mat4
from maps.labels.portraits import portray
from tests.edge.changes.plate_scene import PLATE, around, draw, plate_object

CAMERA = CameraModel(160, 120, 105.0, 105.0, 79.5, 59.5)


class Images:
    """Draws the images that are asked for, and counts them."""

    def __init__(self, poses: list[Mat4]) -> None:
        self.poses = poses
        self.asked: list[int] = []

    def __call__(self, k: int) -> U8 | None:
        self.asked.append(k)
        return draw(CAMERA, self.poses[k], PLATE, (0.0, 0.0))


def portrayed(things: list[MapObject], poses: list[Mat4]) -> tuple[list[MapObject], Images]:
    images = Images(poses)
    return portray(things, poses, [CAMERA] * len(poses), images), images


def test_portraits_show_a_thing_from_all_around_and_few_times() -> None:
    poses = around(np.linspace(-40.0, 40.0, 161).tolist())
    (thing,), images = portrayed([plate_object(poses)], poses)

    angles = np.linspace(-40.0, 40.0, 161)[[p.view for p in thing.portraits]]
    assert 5 <= len(angles) <= 8
    assert np.abs(np.linspace(-40.0, 40.0, 161)[:, None] - angles).min(axis=1).max() <= 10.0
    assert images.asked == sorted(set(images.asked))
    for portrait in thing.portraits:
        assert portrait.grey.std() > 5.0
        assert abs(np.linalg.norm(portrait.right) - 1.0) < 1e-9
        assert abs(portrait.right @ thing.view_directions[portrait.view]) < 1e-9


def test_near_and_far_are_portrayed_apart() -> None:
    poses = [*around([0.0], 1.0), *around([0.0], 3.0)]
    (thing,), _ = portrayed([plate_object(poses)], poses)

    assert {p.view for p in thing.portraits} == {0, 1}


def test_views_that_missed_it_or_show_it_in_part_give_no_portrait() -> None:
    poses = around([-20.0, 0.0, 20.0])
    poses[1][0, 3] += 0.75  # its right half is outside
    thing = plate_object(poses)
    thing.found[2] = False

    (portrayed_thing,), images = portrayed([thing], poses)

    assert [p.view for p in portrayed_thing.portraits] == [0]
    assert 2 not in images.asked


def test_an_image_that_cannot_be_read_is_left_out() -> None:
    poses = around([-20.0, 0.0, 20.0])
    drawn = Images(poses)
    (thing,) = portray(
        [plate_object(poses)], poses, [CAMERA] * 3, lambda k: None if k == 1 else drawn(k)
    )

    assert sorted(p.view for p in thing.portraits) == [0, 2]


def test_several_things_share_the_images() -> None:
    poses = around([-10.0, 0.0, 10.0])
    things, images = portrayed([plate_object(poses), plate_object(poses)], poses)

    assert len(images.asked) == len(set(images.asked))
    assert [p.view for p in things[0].portraits] == [p.view for p in things[1].portraits]
    assert portrayed([], poses)[0] == []
