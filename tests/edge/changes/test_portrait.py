# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.changes.portrait import is_as_portrayed
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject
from edge.types import U8
from maps.labels.portraits import portray
from tests.edge.changes.plate_scene import OTHER, PLATE, SIDE_M, around, draw, plate_object

CAMERA = CameraModel(320, 240, 210.0, 210.0, 159.5, 119.5)
LENS = CameraModel(400, 300, 230.0, 232.0, 204.0, 147.0, "radtan", (-0.2, 0.05, 0.001, 0.0))
HERE = (0.0, 0.0)


@pytest.fixture(scope="module")
def plate() -> MapObject:
    poses = around([-30.0, -15.0, 0.0, 15.0])
    images = [draw(CAMERA, T, PLATE, HERE) for T in poses]
    (thing,) = portray([plate_object(poses)], poses, [CAMERA] * 4, lambda k: images[k])
    assert len(thing.portraits) == 4
    return thing


def seen(
    plate: MapObject,
    shown: int | None = PLATE,
    camera: CameraModel = CAMERA,
    *,
    degrees: float = 7.0,
    distance_m: float = 1.6,
    center: tuple[float, float] = HERE,
) -> tuple[bool, U8]:
    (T,) = around([degrees], distance_m)
    image = draw(camera, T, shown, center)
    return is_as_portrayed(plate, image, camera, T), image


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["same", "another lens"])
@pytest.mark.parametrize(
    ("degrees", "distance_m"), [(0.0, 1.6), (-35.0, 1.6), (7.0, 1.2), (-22.0, 2.4)]
)
def test_what_is_still_there_looks_as_it_did(
    plate: MapObject, camera: CameraModel, degrees: float, distance_m: float
) -> None:
    assert seen(plate, camera=camera, degrees=degrees, distance_m=distance_m)[0]


@pytest.mark.parametrize("shown", [None, OTHER], ids=["gone", "replaced"])
@pytest.mark.parametrize("degrees", [-30.0, -8.0, 0.0, 7.0, 15.0])
def test_what_has_gone_does_not(plate: MapObject, shown: int | None, degrees: float) -> None:
    assert not seen(plate, shown, degrees=degrees)[0]


def test_what_was_moved_by_half_its_size_does_not(plate: MapObject) -> None:
    assert not seen(plate, center=(0.5 * SIDE_M, 0.0))[0]


def test_light_exposure_and_noise_change_nothing(plate: MapObject) -> None:
    (T,) = around([7.0])
    noise = np.random.default_rng(0).normal(0.0, 2.0, (240, 320))
    dark = np.clip(0.5 * draw(CAMERA, T, PLATE, HERE) + 40.0 + noise, 0, 255).astype(np.uint8)

    assert is_as_portrayed(plate, dark, CAMERA, T)


def test_a_pose_off_by_two_pixels_changes_nothing(plate: MapObject) -> None:
    (T,) = around([0.0])
    image = draw(CAMERA, T, PLATE, HERE)

    assert is_as_portrayed(plate, np.roll(image, (2, -2), (0, 1)), CAMERA, T)


def test_from_another_side_or_far_away_portraits_tell_nothing(plate: MapObject) -> None:
    assert not seen(plate, degrees=33.0)[0]
    assert not seen(plate, distance_m=3.2)[0]


def test_nothing_is_told_of_what_is_half_outside_hidden_or_plain(plate: MapObject) -> None:
    (T,) = around([0.0])
    outside = T.copy()
    outside[0, 3] += 1.2
    assert not is_as_portrayed(plate, draw(CAMERA, outside, PLATE, HERE), CAMERA, outside)

    hidden = draw(CAMERA, T, PLATE, HERE)
    hidden[:, :160] = 90
    assert not is_as_portrayed(plate, hidden, CAMERA, T)

    for level in (0, 128, 255):
        plain = np.full((240, 320), level, np.uint8)
        assert not is_as_portrayed(plate, plain, CAMERA, T)
        blank = plate.portraits[2]._replace(grey=np.full((32, 32), level, np.uint8))
        bare = MapObject(1, plate.points, plate.cameras, plate.found, None, (blank,))
        assert not is_as_portrayed(bare, draw(CAMERA, T, PLATE, HERE), CAMERA, T)


def test_a_thing_without_portraits_is_never_recognised(plate: MapObject) -> None:
    (T,) = around([0.0])
    bare = MapObject(1, plate.points, plate.cameras, plate.found)

    assert not is_as_portrayed(bare, draw(CAMERA, T, PLATE, HERE), CAMERA, T)
