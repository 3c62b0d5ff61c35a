# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.config.features import OrbConfig
from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.reader import open_map
from edge.types import F64
from maps.build import BuildInput, build
from maps.depth.multiview import with_multiview_depth
from maps.depth.neighbours import choose_neighbours
from maps.depth.sweep import fine_image, gradient_pixels, sweep
from maps.settings import BuildSettings
from maps.survey import Survey
from maps.views import choose_views
from maps.work_folder import WorkFolder
from maps.workers import open_workers
from tests.maps import wall_drive
from tests.maps.point_world import World
from tests.maps.wall_drive import CAMERA, WALL_Z_M, write_wall_drive

RANGE = (0.25, 1.0)


def swept(T: list[F64], camera: CameraModel = CAMERA):  # type: ignore[no-untyped-def]
    paint = wall_drive.wall()
    images = [fine_image(wall_drive.picture(paint, pose), camera) for pose in T]
    pixels = gradient_pixels(images[0], OdometryConfig())
    T_others = [se3.inverse(pose) @ T[0] for pose in T[1:]]
    return sweep(images[0], images[1:], T_others, RANGE, pixels)


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0) -> F64:
    return se3.exp((x, y, z, 0.0, turn, 0.0))


@pytest.mark.parametrize(
    "others",
    [
        [moved(0.15), moved(-0.15)],
        [moved(0.0, 0.12), moved(0.1), moved(-0.1, -0.1), moved(0.05, 0.1)],
        [moved(z=0.4), moved(0.1, z=-0.2)],
        [moved(0.15, turn=-0.1), moved(-0.15, turn=0.1), moved(0.0, 0.15)],
    ],
    ids=["two", "four", "forward", "turned"],
)
def test_depths_of_a_wall_are_right(others: list[F64]) -> None:
    found = swept([np.eye(4), *others])
    known = found.rho > 0.0
    error = np.abs(1.0 / found.rho[known] / WALL_Z_M - 1.0)
    assert known.mean() > 0.7
    assert np.median(error) < 0.01
    assert np.mean(error < 0.05) > 0.93
    # Deviations are never too small: the median of a unit normal's size is 0.67.
    off = np.abs(found.rho[known] - 1.0 / WALL_Z_M) / found.sigma[known]
    assert 0.02 < np.median(off) < 1.5


def test_the_brightness_of_a_neighbour_does_not_matter() -> None:
    paint = wall_drive.wall()
    T = [np.eye(4), moved(0.15), moved(-0.15)]
    images = [wall_drive.picture(paint, pose) for pose in T]
    images[1] = (0.5 * images[1] + 60).astype(np.uint8)
    fine = [fine_image(image, CAMERA) for image in images]
    pixels = gradient_pixels(fine[0], OdometryConfig())
    found = sweep(fine[0], fine[1:], [se3.inverse(pose) for pose in T[1:]], RANGE, pixels)
    known = found.rho > 0.0
    assert known.mean() > 0.6
    assert np.median(np.abs(1.0 / found.rho[known] / WALL_Z_M - 1.0)) < 0.01


def test_nothing_is_known_where_no_neighbour_looks() -> None:
    found = swept([np.eye(4), moved(0.5), moved(0.6)])
    # A point at the left edge lies at x = -1.24 m; the first neighbour sees from -0.74 m on.
    unseen = found.pixels[:, 0] < 20
    assert np.all(found.rho[unseen] == 0.0)
    assert np.mean(found.rho[found.pixels[:, 0] > 160] > 0.0) > 0.5


def test_neighbours_see_the_same_from_well_apart() -> None:
    world = World(n_views=9, baseline=0.06)
    found = choose_neighbours(world.fused(), world.poses, 3)
    middle = found[4]
    assert middle is not None
    # 6 degrees at 4 m are 0.42 m; views next door are 0.06 m away.
    assert min(abs(view - 4) for view in middle.views) >= 3
    assert {view < 4 for view in middle.views} == {True, False}
    depth = world.xyz[:, 2]
    assert middle.rho_range[0] < 1.0 / depth.max()
    assert middle.rho_range[1] > 1.0 / depth.min()


def test_a_neighbour_is_worth_what_the_others_do_not_see() -> None:
    world = World(n_views=9, baseline=0.06)
    points = world.fused()
    owner = np.repeat(np.arange(len(points.xyz)), np.diff(points.offsets))
    # One side sees three of five points, the other side the rest.
    left, right = owner % 5 < 3, owner % 5 >= 3
    kept = (points.view == 4) | ((points.view < 4) & left) | ((points.view > 4) & right)
    counts = np.bincount(owner[kept], minlength=len(points.xyz))
    seen = points._replace(
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        view=points.view[kept],
        feature=points.feature[kept],
    )
    middle = choose_neighbours(seen, world.poses, 2)[4]
    assert middle is not None
    assert middle.views == [0, 8]


def test_a_view_that_shares_nothing_has_no_neighbours() -> None:
    world = World(n_views=4)
    points = world.fused()
    away = [*world.poses, moved(100.0)]
    assert choose_neighbours(points, away, 3)[4] is None


def test_a_large_image_is_measured_at_half_its_size() -> None:
    camera = CameraModel(1280, 960, 1040.0, 1048.0, 645.5, 475.5)
    fine = fine_image(np.zeros((960, 1280), np.uint8), camera)
    assert fine.grey.shape == (480, 640)
    assert fine.halvings == 1
    assert fine.pinhole.cx == pytest.approx((645.5 + 0.5) / 2 - 0.5)


def test_a_build_gets_depths_from_its_images_alone(tmp_path: Path) -> None:
    drive = write_wall_drive(tmp_path / "wall", 5)
    settings = BuildSettings(depth="multiview", lens="given")
    build(BuildInput([drive]), tmp_path / "map", settings)
    opened = open_map(tmp_path / "map")
    samples = opened.depth_samples(2)
    assert len(samples.pixels) > 150
    u, v = np.round(samples.pixels).astype(int).T
    truth = 1.0 / wall_drive.depth(opened.pose(2))[v, u]
    off = np.abs(samples.inverse_depth - truth)
    assert np.median(off) < 0.005
    assert np.mean(off < 4.0 * samples.sigma) > 0.95
    points = opened.points(np.arange(opened.n_points, dtype=np.int32))
    alone = points.n_views == 1
    assert alone.sum() > 20
    assert np.median(np.abs(points.xyz[alone, 2] - WALL_Z_M)) < 0.03


def test_only_features_without_a_point_get_a_depth(tmp_path: Path) -> None:
    drive = write_wall_drive(tmp_path / "wall", 4)
    settings = BuildSettings(depth="multiview", lens="given")
    chosen = choose_views([drive], None, 1, frozenset())
    with open_workers(1) as workers:
        survey = Survey(OrbConfig(), workers, WorkFolder(tmp_path / "work"))
        measured = survey.measure(chosen, survey.describe(chosen, settings), settings)
        points = measured.points
        found = with_multiview_depth(
            chosen, measured.descriptions, points, settings, workers, survey.work
        )
    for number, described in enumerate(found):
        explained = points.feature[points.view == number]
        assert np.all(described.depth[explained] == 0.0)
        assert np.count_nonzero(described.depth) > 10


def test_images_that_changed_since_the_last_build_are_read_anew(tmp_path: Path) -> None:
    settings = BuildSettings(depth="multiview", lens="given")
    first = write_wall_drive(tmp_path / "a" / "wall", 3, seed=1)
    build(BuildInput([first]), tmp_path / "old", settings)
    second = write_wall_drive(tmp_path / "b" / "wall", 3, seed=2)
    for path in (second / "rgb").iterdir():
        (first / "rgb" / path.name).write_bytes(path.read_bytes())
    (first / "groundtruth.txt").write_bytes((second / "groundtruth.txt").read_bytes())
    build(BuildInput([first]), tmp_path / "again", settings)
    build(BuildInput([second]), tmp_path / "fresh", settings)
    again, fresh = (open_map(tmp_path / name).manifest for name in ("again", "fresh"))
    assert again == fresh
