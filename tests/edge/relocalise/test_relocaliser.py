# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

import edge.runtime
from edge.config.relocalise import RelocaliseConfig
from edge.geometry import se3
from edge.relocalise.relocaliser import Relocaliser
from edge.runtime.synthetic import WallDrive
from edge.tiles.reader import open_map
from edge.types import DepthSamples, Fix, Frame, Query

WALL_MAP = Path(edge.runtime.__file__).parent / "warm_up_map"
SURE = np.diag(np.repeat((0.02**2, 0.01**2), 3))


@pytest.fixture(scope="module")
def drive() -> WallDrive:
    return WallDrive(60)


@pytest.fixture(scope="module")
def relocaliser(drive: WallDrive) -> Relocaliser:
    return Relocaliser(open_map(WALL_MAP), drive.camera, RelocaliseConfig())


def frame(drive: WallDrive, index: int) -> Frame:
    return Frame(index, index * 33_000_000, drive.image(index))


def off_m(fix: Fix, drive: WallDrive) -> float:
    assert fix.T_map_cam is not None
    return float(np.linalg.norm(fix.T_map_cam[:3, 3] - drive.pose(fix.index)[:3, 3]))


@pytest.mark.parametrize("index", [3, 21, 39, 57])
def test_a_lost_image_is_found(relocaliser: Relocaliser, drive: WallDrive, index: int) -> None:
    fix = relocaliser.step(Query(frame(drive, index)))
    assert (fix.found, fix.reason) == (True, "ok")
    assert off_m(fix, drive) < 0.005
    assert fix.covariance is not None
    assert fix.depth_m == pytest.approx(2.0, rel=0.15)
    assert set(fix.support) <= set(range(4))


def test_a_prior_leads_to_the_same_place(relocaliser: Relocaliser, drive: WallDrive) -> None:
    lost = relocaliser.step(Query(frame(drive, 21)))
    T_prior = se3.exp([0.02, -0.02, 0.01, 0.005, 0.01, 0.0]) @ drive.pose(21)
    led = relocaliser.step(Query(frame(drive, 21), T_map_cam_prior=T_prior, prior_covariance=SURE))
    assert led.found
    assert off_m(led, drive) < 0.005
    assert lost.T_map_cam is not None
    np.testing.assert_allclose(led.T_map_cam, lost.T_map_cam, atol=1e-3)


def test_a_wrong_prior_does_not_mislead(relocaliser: Relocaliser, drive: WallDrive) -> None:
    T_wrong = se3.exp([0.4, 0.1, 0.0, 0.0, 0.3, 0.0]) @ drive.pose(21)
    fix = relocaliser.step(Query(frame(drive, 21), T_map_cam_prior=T_wrong, prior_covariance=SURE))
    assert fix.found
    assert off_m(fix, drive) < 0.005


def test_without_guidance_a_prior_changes_nothing(drive: WallDrive) -> None:
    config = RelocaliseConfig(guided=False, near_last_place=0)
    lone = Relocaliser(open_map(WALL_MAP), drive.camera, config)
    T_wrong = se3.exp([0.3, 0.0, 0.0, 0.0, 0.2, 0.0]) @ drive.pose(21)
    a = lone.step(Query(frame(drive, 21)))
    b = lone.step(Query(frame(drive, 21), T_map_cam_prior=T_wrong, prior_covariance=SURE))
    assert a.found
    np.testing.assert_array_equal(a.T_map_cam, b.T_map_cam)
    assert a.candidates == b.candidates


def test_scale_comes_from_the_odometrys_depths(relocaliser: Relocaliser, drive: WallDrive) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform((0, 0), (639, 479), (4000, 2)).astype(np.float32)
    depth = drive.depth(30)[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    inverse = (0.4 / depth).astype(np.float32)
    samples = DepthSamples(pixels, inverse, 0.01 * inverse)
    fix = relocaliser.step(Query(frame(drive, 30), 1, np.eye(4), samples))
    assert fix.log_scale == pytest.approx(np.log(0.4), abs=0.01)
    assert fix.odom_id == 1


@pytest.mark.parametrize("what", ["black", "white", "noise", "mirrored", "tiny texture"])
def test_what_is_not_the_place_is_not_found(
    relocaliser: Relocaliser, drive: WallDrive, what: str
) -> None:
    rng = np.random.default_rng(0)
    images = {
        "black": np.zeros((480, 640), np.uint8),
        "white": np.full((480, 640), 255, np.uint8),
        "noise": rng.integers(0, 256, (480, 640), np.uint8),
        "mirrored": np.ascontiguousarray(drive.image(21)[:, ::-1]),
        "tiny texture": np.tile(rng.integers(0, 256, (8, 8), np.uint8), (60, 80)),
    }
    fix = relocaliser.step(Query(Frame(0, 0, images[what])))
    assert not fix.found
    assert fix.reason != "ok"


def test_answers_do_not_depend_on_earlier_queries(drive: WallDrive) -> None:
    config = RelocaliseConfig()
    fresh = Relocaliser(open_map(WALL_MAP), drive.camera, config)
    used = Relocaliser(open_map(WALL_MAP), drive.camera, config)
    for index in (3, 50, 12):
        used.step(Query(frame(drive, index)))
    a, b = (r.step(Query(frame(drive, 30))) for r in (fresh, used))
    assert a.T_map_cam is not None
    np.testing.assert_array_equal(a.T_map_cam, b.T_map_cam)
    np.testing.assert_array_equal(a.covariance, b.covariance)
    assert (a.support, a.matches, a.inliers) == (b.support, b.matches, b.inliers)


def test_a_map_of_which_next_to_nothing_may_stay_in_memory_gives_the_same(
    relocaliser: Relocaliser, drive: WallDrive
) -> None:
    tight = open_map(WALL_MAP, resident_bytes=1)
    other = Relocaliser(tight, drive.camera, RelocaliseConfig())
    for query in (
        Query(frame(drive, 30)),
        Query(frame(drive, 21), T_map_cam_prior=drive.pose(21), prior_covariance=SURE),
    ):
        a, b = relocaliser.step(query), other.step(query)
        assert a.found
        np.testing.assert_array_equal(a.T_map_cam, b.T_map_cam)
        np.testing.assert_array_equal(a.covariance, b.covariance)
