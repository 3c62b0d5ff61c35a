# SPDX-License-Identifier: Apache-2.0
"""Pictures against geometry: views agree, edges and textures do not flicker."""

import cv2
import numpy as np
import pytest

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import F64
from tests.tools.simworld.conftest import SMALL, make_corner
from tools.simworld.objects import KEY_COLOURS
from tools.simworld.packing import PAINTERS, paint
from tools.simworld.paths import make_path
from tools.simworld.renderer import Rendered, Renderer
from tools.simworld.rooms import STYLES, make_room
from tools.simworld.world import Texture

FULL = CameraModel(640, 480, 420.0, 420.0, 319.5, 239.5)


def reproject(a: Rendered, T_b_a: F64, b: Rendered) -> tuple[F64, F64, F64]:
    """Depth [m] of a's pixels as b should and does see them, and the grey differences.

    Only pixels that land where b's depth varies little, off the edges.
    """
    v, u = np.mgrid[0:120, 0:160].reshape(2, -1).astype(np.float64)
    rays = np.stack([*SMALL.normalise(np.stack([u, v], axis=1)).T, np.ones_like(u)], axis=1)
    p = se3.transform(T_b_a, rays * a.depth_m.reshape(-1, 1))
    uv = SMALL.project(p).astype(np.float32)
    map_u, map_v = np.ascontiguousarray(uv.T).reshape(2, 120, 160)
    near = cv2.remap(cv2.erode(b.depth_m, np.ones((3, 3))), map_u, map_v, cv2.INTER_NEAREST).ravel()
    far = cv2.remap(cv2.dilate(b.depth_m, np.ones((3, 3))), map_u, map_v, cv2.INTER_NEAREST).ravel()
    inverse = cv2.remap(1.0 / b.depth_m, map_u, map_v, cv2.INTER_LINEAR).ravel()
    grey_b = cv2.remap(b.colour.mean(axis=2), map_u, map_v, cv2.INTER_LINEAR).ravel()
    inside = (uv > 1).all(axis=1) & (uv < (158, 118)).all(axis=1) & (p[:, 2] > 0)
    good = inside & (near > 0.94 * far)
    difference = grey_b - a.colour.mean(axis=2).ravel()
    return p[good, 2], 1.0 / inverse[good], np.abs(difference[good])


@pytest.mark.parametrize("gap", [4, 20])
def test_depth_and_colour_of_one_view_predict_another(office: Renderer, gap: int) -> None:
    T = make_path(office.world, 3, 3.0).T_world_cam
    a, b = office.render(T[10]), office.render(T[10 + gap])
    expected, seen, grey = reproject(a, se3.inverse(T[10 + gap]) @ T[10], b)
    assert len(expected) > 5000
    # a point may be hidden by something nearer, but never float before what b sees
    assert np.mean(expected > 0.99 * seen) > 0.99
    same = np.abs(expected / seen - 1.0) < 1e-3
    assert same.mean() > 0.75
    # most of it lies on planes, where the inverse depth is linear over the image; what is
    # left is OpenCV's interpolation in steps of 1/32 pixel
    assert np.median(np.abs(expected[same] / seen[same] - 1.0)) < 1e-4
    assert np.median(grey[same]) < 4.0


def test_depth_is_along_the_optical_axis(corner: Renderer) -> None:
    # straight at the north wall from 3.2 m: the same depth all over it
    T = np.array([[1.0, 0, 0, 0], [0, 0, 1, -1.2], [0, -1, 0, 2.2], [0, 0, 0, 1]])
    view = corner.render(T)
    assert (view.ids[55:65, 30:130] == 1).all()
    assert view.depth_m[55:65, 30:130] == pytest.approx(3.2)


def test_ids_name_what_stands_there(corner: Renderer) -> None:
    T = make_path(corner.world, 2, 2.0).T_world_cam[0]
    for thing in corner.world.things:
        if thing.label not in ("ball", "carton"):
            continue
        low, high = thing.bounds()
        centre = 0.5 * (low + high)
        ahead = centre - T[:3, 3]
        yaw = np.arctan2(ahead[1], ahead[0])
        look = np.eye(4)
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        ahead /= np.linalg.norm(ahead)
        look[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        look[:3, 3] = centre - 0.9 * ahead
        view = corner.render(look)
        assert view.ids[59, 79] == thing.id
        blue, green, red = view.bgr[59, 79].astype(int)
        expected = red if thing.label == "ball" else green
        assert expected > 2 * sorted((blue, green, red))[1]


def test_only_key_things_wear_key_colours(office: Renderer) -> None:
    labels = {t.id: t.label for t in office.world.things}
    counted = 0
    for T in make_path(office.world, 5, 26.0, 1.0).T_world_cam:
        view = office.render(T)
        _, saturation, value = cv2.split(cv2.cvtColor(view.bgr, cv2.COLOR_BGR2HSV))
        keyed = (saturation > 200) & (value > 80)
        # a rim shares its pixels with what it stands before
        core = keyed & (cv2.dilate(view.ids.astype(np.uint16), np.ones((3, 3))) == view.ids)
        wearers = {labels[i] for i in np.unique(view.ids[core])}
        assert wearers <= set(KEY_COLOURS)
        counted += len(wearers)
    assert counted > 30


def test_picture_equals_one_of_many_samples(office: Renderer) -> None:
    """Prefiltered textures and sampled edges give what brute supersampling gives."""
    T = make_path(office.world, 3, 3.0).T_world_cam[30]
    k, (w, h) = 4, (320, 240)
    one = office.through(CameraModel(w, h, 210.0, 210.0, w / 2 - 0.5, h / 2 - 0.5)).render(T)
    fine = CameraModel(w * k, h * k, 210.0 * k, 210.0 * k, w / 2 * k - 0.5, h / 2 * k - 0.5)
    many = office.through(fine).render(T).colour.reshape(h, k, w, k, 3).mean(axis=(1, 3))
    difference = np.abs(one.colour - many)
    assert difference.mean() < 2.5  # grey values
    assert np.percentile(difference, 99) < 20.0


def test_picture_changes_smoothly_under_sub_pixel_motion(office: Renderer) -> None:
    T = make_path(office.world, 3, 3.0).T_world_cam[30]
    renderer = office.through(FULL)
    turn = 0.25 / 420.0  # a quarter of a pixel
    steps = [
        renderer.render(T @ se3.exp([0, 0, 0, 0.3 * i * turn, i * turn, 0])).colour
        for i in range(6)
    ]
    first = np.diff(steps, axis=0)
    second = np.diff(first, axis=0)
    # 0.65 is what brute supersampling gives; jagged edges or bare textures give 1 and more
    assert second.std() < 0.72 * first.std()


def test_same_seed_gives_the_same_bytes() -> None:
    T = make_path(make_corner(), 2, 1.0).T_world_cam[3]
    pictures = []
    for _ in range(2):
        paint.cache_clear()
        pictures.append(Renderer(make_corner(), SMALL).render(T))
    assert pictures[0].colour.tobytes() == pictures[1].colour.tobytes()
    assert pictures[0].depth_m.tobytes() == pictures[1].depth_m.tobytes()
    other = Renderer(make_corner(2), SMALL).render(T)
    assert (other.bgr != pictures[0].bgr).any()


@pytest.mark.parametrize("kind", sorted(set(PAINTERS) - {"uniform"}))
def test_textures_are_reproducible_and_not_empty(kind: str) -> None:
    texture = Texture(kind, (120.0, 140.0, 160.0), 7, (128, 256))
    image = paint(texture)
    assert image.shape == (128, 256, 3)
    assert image.std() > (0.3 if kind == "plain" else 3.0)
    paint.cache_clear()
    np.testing.assert_array_equal(paint(texture), image)
    assert (paint(Texture(kind, (120.0, 140.0, 160.0), 8, (128, 256))) != image).any()


@pytest.mark.parametrize("kind", ["brick", "carpet", "plaster", "speckle", "terrazzo", "wood"])
def test_materials_repeat_without_a_seam(kind: str) -> None:
    image = paint(Texture(kind, (120.0, 140.0, 160.0), 7, (128, 128))).astype(float)
    for axis in (0, 1):
        inside = np.abs(np.diff(image, axis=axis)).mean(axis=(1 - axis, 2))
        seam = np.abs(np.take(image, 0, axis) - np.take(image, -1, axis)).mean()
        assert seam <= inside.max() + 1.0


def test_rooms_of_one_look_share_textures_but_not_places() -> None:
    a, b = make_room(1, look_seed=9), make_room(2, look_seed=9)
    assert a.things[0].parts[0].faces == b.things[0].parts[0].faces
    posters = [
        {t.parts[0].faces[2].texture for t in w.things if t.name.startswith("poster")}
        for w in (a, b)
    ]
    assert posters[0] & posters[1]
    places = [
        {t.name: tuple(t.T_world_thing[:3, 3]) for t in w.things if t.movable} for w in (a, b)
    ]
    assert not set(places[0].values()) & set(places[1].values())


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("seed", range(6))
def test_nothing_sticks_out_of_its_room(style: str, seed: int) -> None:
    """The tracer takes the walls for the last thing that a ray can hit."""
    world = make_room(seed, style)
    for thing in world.things:
        low, high = thing.bounds()
        assert (low[:2] >= -0.5 * np.array(world.size_m[:2]) - 1e-9).all(), thing.name
        assert (high[:2] <= 0.5 * np.array(world.size_m[:2]) + 1e-9).all(), thing.name
        assert -1e-9 <= low[2] <= high[2] <= world.size_m[2] + 1e-9, thing.name


@pytest.mark.slow
def test_office_gives_500_corners_in_every_frame(office: Renderer) -> None:
    renderer = office.through(FULL)
    orb = cv2.ORB_create(2000)
    for T in make_path(office.world, 5, 13.0, 1.0).T_world_cam:
        assert len(orb.detect(cv2.cvtColor(renderer.render(T).bgr, cv2.COLOR_BGR2GRAY))) >= 500
