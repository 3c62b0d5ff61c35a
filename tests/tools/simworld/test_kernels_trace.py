# SPDX-License-Identifier: Apache-2.0
"""Intersections against formulas, and the culled image against plain search."""

import numpy as np
import pytest

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import F64
from tests.tools.simworld.conftest import SMALL
from tools.simworld.furniture import box, cylinder, ellipsoid, place
from tools.simworld.kernels_trace import FACES, MISS, hit_primitive, trace
from tools.simworld.look import Look
from tools.simworld.packing import pack_prims
from tools.simworld.paths import make_path
from tools.simworld.renderer import Renderer, Tracer, camera_rays
from tools.simworld.world import Material, Part, Shape, Texture, Thing, World

PAINT = Material(Texture("plain"))


def prims_of(*parts: Part, T: F64 | None = None) -> F64:
    thing = Thing(1, "it", "it", parts, np.eye(4) if T is None else T)
    return pack_prims(World("", 0, (thing,), (), (0.1, 0.1, 0.1), (4.0, 4.0, 3.0)))


def test_ellipsoid_is_hit_where_its_equation_says() -> None:
    prims = prims_of(ellipsoid((0.5, 1.0, 2.0), (0.0, 0.0, 0.0), PAINT))
    t, face = hit_primitive(prims, 0, (-3.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert (t, face) == (pytest.approx(2.5), 0)
    t, _ = hit_primitive(prims, 0, (-3.0, 0.3, -0.4), (2.0, 0.1, 0.2))
    p = np.array([-3.0, 0.3, -0.4]) + t * np.array([2.0, 0.1, 0.2])
    assert ((p / (0.5, 1.0, 2.0)) ** 2).sum() == pytest.approx(1.0)
    assert hit_primitive(prims, 0, (-3.0, 1.1, 0.0), (1.0, 0.0, 0.0))[0] == MISS
    assert hit_primitive(prims, 0, (3.0, 0.0, 0.0), (1.0, 0.0, 0.0))[0] == MISS  # behind


@pytest.mark.parametrize(
    ("origin", "ray", "t", "face"),
    [
        ((-3.0, 0.0, 0.2), (1.0, 0.0, 0.0), 2.5, 0),
        ((0.1, 0.1, 3.0), (0.0, 0.0, -2.0), 1.0, 5),
        ((0.1, 0.1, -3.0), (0.0, 0.0, 1.0), 2.0, 4),
    ],
)
def test_cylinder_shows_side_and_ends(
    origin: tuple[float, ...], ray: tuple[float, ...], t: float, face: int
) -> None:
    prims = prims_of(cylinder(0.5, 2.0, (0.0, 0.0, 0.0), PAINT))
    assert hit_primitive(prims, 0, origin, ray) == (pytest.approx(t), face)
    aside = (origin[0], origin[1] + 0.6, origin[2])
    assert hit_primitive(prims, 0, aside, ray)[0] == MISS


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1, 1])
def test_box_shows_the_face_that_looks_at_the_ray(axis: int, side: int) -> None:
    prims = prims_of(box((2.0, 4.0, 6.0), (0.0, 0.0, 0.0), PAINT), T=place(1.0, 2.0, 3.0, 0.3))
    R = place(0, 0, 0, 0.3)[:3, :3]
    outside = np.array([1.0, 2.0, 3.0]) + R[:, axis] * side * 10.0 + R @ (0.1, 0.2, 0.3)
    ray = -R[:, axis] * side * 2.0
    t, face = hit_primitive(prims, 0, tuple(outside), tuple(ray))
    assert face == 2 * axis + (side > 0)
    local = R.T @ (outside + t * ray - (1.0, 2.0, 3.0))
    assert local[axis] == pytest.approx(side * (1.0, 2.0, 3.0)[axis])


def test_room_is_hit_from_inside() -> None:
    room = Part(Shape.ROOM, (2.0, 2.0, 1.5), np.eye(4), PAINT)
    assert hit_primitive(prims_of(room), 0, (0.5, 0.0, 0.0), (0.5, 0.0, 0.0)) == (3.0, 1)


LENS = CameraModel(160, 120, 70.0, 72.0, 82.3, 55.1, "equidistant", (0.02, -0.01, 0.003, 0.0))


@pytest.mark.parametrize("camera", [SMALL, LENS], ids=["pinhole", "equidistant"])
@pytest.mark.parametrize("rolling", [False, True], ids=["global", "rolling"])
def test_culled_image_equals_search_over_everything(
    office: Renderer, camera: CameraModel, rolling: bool
) -> None:
    tracer = Tracer(office.world, camera)
    T = make_path(office.world, 4, 2.0).T_world_cam[7]
    rows = np.array([T @ se3.exp(np.arange(6) * 3e-4 * v * rolling) for v in range(120)])
    seen = tracer.trace(rows)
    prims, rays = pack_prims(office.world), camera_rays(camera)
    ids = [thing.id for thing in office.world.things for _ in thing.parts]
    order, free = np.arange(len(prims), dtype=np.int32), np.zeros(len(prims))
    rng = np.random.default_rng(3)
    for v, u in zip(rng.integers(0, 120, 1500), rng.integers(0, 160, 1500), strict=True):
        ray = rows[v, :3, :3] @ (*rays[v, u], 1.0)
        t, k, face = trace(prims, order, free, len(prims), tuple(rows[v, :3, 3]), tuple(ray))
        assert 0 <= face < FACES
        assert seen.depth_m[v, u] == pytest.approx(t, rel=1e-9)
        assert seen.ids[v, u] == ids[k]


def test_pixels_that_the_lens_cannot_see_stay_empty(corner: Renderer) -> None:
    folded = CameraModel(160, 120, 105.0, 105.0, 79.5, 59.5, "radtan", (-0.45, 0.0, 0.0, 0.0))
    assert np.isnan(camera_rays(folded)).any()
    view = corner.through(folded).render(place(0.0, -1.5, 1.3) @ DOWN_Y)
    empty = np.isnan(camera_rays(folded)[:-1, :-1]).any(axis=2)
    assert (view.ids[empty] == 0).all()
    assert (view.depth_m[empty] == 0).all()
    assert (view.bgr[empty] == 0).all()
    assert (view.ids[~empty] > 0).all()


# camera axes (x right, y down, z ahead) in a world with z up, looking along +y
DOWN_Y = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def test_look_hands_out_the_same_sequence_again() -> None:
    assert [Look(5).poster() for _ in range(2)] == [Look(5).poster() for _ in range(2)]
