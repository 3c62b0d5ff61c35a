# SPDX-License-Identifier: Apache-2.0
"""A wall of bright boards before a camera; the map knows their edges exactly, and no point."""

from dataclasses import replace
from itertools import count
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from edge.config.relocalise import RelocaliseConfig
from edge.errors import ConfigError
from edge.geometry import se3, so3
from edge.lines.line import lines_between
from edge.relocalise.line_fixes import LineFixes
from edge.relocalise.relocaliser import Relocaliser
from edge.tiles.reader import Map, open_map
from edge.types import F64, U8, Fix, Frame, Mat4, Query
from maps.content import load, write
from maps.lines.layer import LineLayer
from tests.maps.small_map import N_KEYFRAMES, write_small_map
from tests.maps.wall_drive import CAMERA, PIXELS_PER_M, WALL_SIZE_PX, WALL_Z_M, picture

SIGMA_M = 0.002
PRIOR = np.diag(np.repeat((0.03**2, 0.01**2), 3))


def boards() -> tuple[U8, F64]:
    """The wall (h, w) and the edges (n, 2, 2) of its boards [px], the brighter side on the left."""
    rng = np.random.default_rng(3)
    width, height = WALL_SIZE_PX
    image = np.full((height, width), 90, np.uint8)
    edges = []
    for x in range(100, width - 100, 110):
        for y in range(60, height - 60, 110):
            around = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]]) * rng.uniform(22, 45, (4, 2))
            corners = np.round(np.array([x, y]) + around).astype(np.int32)
            cv2.fillPoly(image, [corners], 225)
            edges += [(corners[k], corners[(k + 1) % 4]) for k in range(4)]
    return image, np.array(edges, np.float64)


PAINT, EDGES = boards()


def in_space(pixels: F64) -> F64:
    places = (pixels - 0.5 * np.array(WALL_SIZE_PX)) / PIXELS_PER_M
    return np.concatenate((places, np.full((*places.shape[:-1], 1), WALL_Z_M)), axis=-1)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Map:
    folder = tmp_path_factory.mktemp("maps")
    points = open_map(write_small_map(folder / "points").folder)
    first, last = in_space(EDGES).transpose(1, 0, 2)
    lines = lines_between(first, last, SIGMA_M)
    half = 0.5 * np.linalg.norm(last - first, axis=1)
    seen = [np.flatnonzero(np.abs(lines.point[:, 0] - k) < 1.3) for k in range(N_KEYFRAMES)]
    views = np.repeat(np.arange(N_KEYFRAMES), [len(rows) for rows in seen])
    rows = np.concatenate(seen).astype(np.int32)
    used, number = np.unique(rows, return_inverse=True)
    layer = LineLayer.of(
        type(lines)(*(array[used] for array in lines)),
        np.stack((-half, half), axis=1)[used],
        np.full(len(used), 3),
        (views.astype(np.int32), number.astype(np.int32)),
    )
    content = load(points)._replace(extra={"lines": layer})
    write(content, points.manifest, folder / "lines")
    return open_map(folder / "lines")


def truth(seed: int) -> Mat4:
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(0.0, [0.05, 0.05, 0.05, 0.05, 0.05, 0.05]))
    T[0, 3] += 1.0
    return T


def asked(T: Mat4, seed: int, image: U8 | None = None) -> Query:
    """A query whose prior is off as much as it says."""
    rng = np.random.default_rng([seed, 1])
    T_prior = se3.from_rotation_translation(
        so3.exp(rng.normal(0.0, 0.01, 3)) @ T[:3, :3], T[:3, 3] + rng.normal(0.0, 0.03, 3)
    )
    image = picture(PAINT, T) if image is None else image
    return Query(Frame(seed, seed, image), T_map_cam_prior=T_prior, prior_covariance=PRIOR)


def settings(landmarks: str) -> RelocaliseConfig:
    return msgspec.structs.replace(RelocaliseConfig(), landmarks=landmarks)


@pytest.mark.parametrize("landmarks", ["both", "lines"])
def test_where_there_are_no_points_lines_tell_the_pose(opened: Map, landmarks: str) -> None:
    relocaliser = Relocaliser(opened, CAMERA, settings(landmarks))
    for seed in range(4):
        T = truth(seed)
        fix = relocaliser.step(asked(T, seed))
        assert fix.found, fix.reason
        assert fix.T_map_cam is not None
        assert fix.covariance is not None
        off = fix.T_map_cam[:3, 3] - T[:3, 3]
        assert np.linalg.norm(off) < 0.01
        assert off @ np.linalg.solve(fix.covariance[:3, :3], off) < 16.0
        assert so3.angle(fix.T_map_cam[:3, :3].T @ T[:3, :3]) < 0.005
        assert fix.lines == fix.inliers >= 8
        assert fix.depth_m == pytest.approx(WALL_Z_M - T[2, 3], rel=0.2)
        assert fix.depth is not None
        rays = (fix.depth.pixels - (CAMERA.cx, CAMERA.cy)) / (CAMERA.fx, CAMERA.fy)
        seen = np.insert(rays, 2, 1.0, axis=1) / fix.depth.inverse_depth[:, None]
        assert len(seen) > 60
        assert se3.transform(T, seen)[:, 2] == pytest.approx(WALL_Z_M, abs=0.05)


def test_points_alone_take_no_notice_of_lines(opened: Map) -> None:
    assert not Relocaliser(opened, CAMERA, settings("points")).step(asked(truth(0), 0)).found


def test_without_lines_in_the_map_there_is_no_going_by_lines(tmp_path: Path) -> None:
    bare = open_map(write_small_map(tmp_path / "points").folder)
    with pytest.raises(ConfigError, match="--lines"):
        Relocaliser(bare, CAMERA, settings("lines"))
    assert not Relocaliser(bare, CAMERA, settings("both")).step(asked(truth(0), 0)).found


def test_lines_need_to_know_about_where(opened: Map) -> None:
    query = replace(asked(truth(0), 0), T_map_cam_prior=None, prior_covariance=None)
    for landmarks in ("both", "lines"):
        assert not Relocaliser(opened, CAMERA, settings(landmarks)).step(query).found


def test_a_rough_prior_is_no_start_for_lines_alone(opened: Map) -> None:
    """Some pixels off, a parallel neighbour is as near as the line itself."""
    query = replace(asked(truth(0), 0), prior_covariance=9.0 * PRIOR)
    fix = Relocaliser(opened, CAMERA, settings("lines")).step(query)
    assert (fix.found, fix.reason) == (False, "known too roughly for lines")


@pytest.mark.parametrize("grey", [0, 128])
def test_an_empty_image_is_not_found(opened: Map, grey: int) -> None:
    image = np.full((CAMERA.height, CAMERA.width), grey, np.uint8)
    fix = Relocaliser(opened, CAMERA, settings("lines")).step(asked(truth(0), 0, image))
    assert (fix.found, fix.lines) == (False, 0)


def test_an_image_from_elsewhere_is_not_found(opened: Map) -> None:
    mirrored = np.ascontiguousarray(picture(PAINT, truth(0))[:, ::-1])
    inverted = 255 - picture(PAINT, truth(0))
    for image in (mirrored, inverted):
        fix = Relocaliser(opened, CAMERA, settings("lines")).step(asked(truth(0), 0, image))
        assert not fix.found


def by_points(T: Mat4, sigma_m: float, off_m: float) -> Fix:
    T_fix = T.copy()
    T_fix[2, 3] += off_m
    variance = np.repeat((sigma_m**2, (0.5 * sigma_m) ** 2), 3)
    return Fix(
        0, 0, None, None, True, "ok", inliers=30, T_map_cam=T_fix, covariance=np.diag(variance),
        depth_m=WALL_Z_M,
    )  # fmt: skip


def test_a_certain_fix_costs_no_look_at_lines(opened: Map) -> None:
    lines = LineFixes(opened, CAMERA, settings("both"))
    fix = by_points(truth(0), 0.001, 0.0)
    assert lines.added(asked(truth(0), 0), fix) is fix


@pytest.mark.parametrize("off_m", [0.0, 0.08])
def test_a_look_at_lines_is_told_with_its_cost(opened: Map, off_m: float) -> None:
    lines = LineFixes(opened, CAMERA, settings("both"), count(0, 1_000_000).__next__)
    for _ in range(2):  # each search is told with its own fix
        fix = lines.added(asked(truth(0), 0), by_points(truth(0), 0.009, off_m))
        assert bool(fix.lines) is (off_m == 0.0)
        ((segments, ms),) = fix.line_searches
        assert segments > 20
        assert ms == 1.0


def test_lines_better_a_doubtful_fix_and_say_by_how_much(opened: Map) -> None:
    lines = LineFixes(opened, CAMERA, settings("both"))
    for seed in range(3):
        T = truth(seed)
        fix = lines.added(asked(T, seed), by_points(T, 0.03, 0.03))
        assert fix.T_map_cam is not None
        assert fix.covariance is not None
        assert np.linalg.norm(fix.T_map_cam[:3, 3] - T[:3, 3]) < 0.01
        assert np.all(np.linalg.eigvalsh(np.diag([0.03**2] * 3) - fix.covariance[:3, :3]) > 0.0)
        assert fix.inliers == 30 + fix.lines


def test_points_are_believed_where_lines_tell_another_place(opened: Map) -> None:
    lines = LineFixes(opened, CAMERA, settings("both"))
    fix = by_points(truth(0), 0.009, 0.08)
    found = lines.added(asked(truth(0), 0), fix)
    assert found.T_map_cam is fix.T_map_cam
    assert found.covariance is fix.covariance
    assert found.lines == 0
