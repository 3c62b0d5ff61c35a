# SPDX-License-Identifier: Apache-2.0
from dataclasses import dataclass

import numpy as np
import pytest

from edge.config.features import OrbConfig
from edge.geometry import se3
from edge.relocalise.features import OrbExtractor
from edge.types import F64, Mat4
from maps.matching import Matches, MatchSide, match, match_side
from maps.settings import BuildSettings
from tests.maps import wall_drive
from tests.maps.wall_drive import CAMERA

SETTINGS = BuildSettings()


@dataclass
class Drive:
    poses: list[Mat4]
    sides: list[MatchSide]

    def match(self, i: int, j: int, settings: BuildSettings = SETTINGS) -> Matches:
        T_j_i = se3.inverse(self.poses[j]) @ self.poses[i]
        return match(self.sides[i], self.sides[j], T_j_i, settings)

    def errors_px(self, i: int, j: int, found: Matches) -> F64:
        """How far each match lies from where the wall says."""
        rays = self.sides[i].rays[found.first] @ self.poses[i][:3, :3].T
        along = (wall_drive.WALL_Z_M - self.poses[i][2, 3]) / rays[:, 2]
        world = self.poses[i][:3, 3] + rays * along[:, None]
        T = se3.inverse(self.poses[j])
        camera = world @ T[:3, :3].T + T[:3, 3]
        seen = camera[:, :2] / camera[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
        off: F64 = np.linalg.norm(seen - self.sides[j].pixels[found.second], axis=1)
        return off / np.maximum(self.sides[i].sigma[found.first], self.sides[j].sigma[found.second])


def make_drive(*, with_depth: bool = False) -> Drive:
    extractor = OrbExtractor(OrbConfig(max_features=500))
    paint, sides = wall_drive.wall(), []
    poses = list(wall_drive.poses(4))
    for T in poses:
        features = extractor.extract(wall_drive.picture(paint, T), CAMERA)
        depth, sigma = np.zeros((2, len(features.pixels)))
        if with_depth:
            u, v = np.round(features.pixels).astype(int).T
            depth, sigma = wall_drive.depth(T)[v, u], np.full(len(u), 0.01)
        sides.append(match_side(features, CAMERA.pinhole, extractor.config, depth, sigma))
    return Drive(poses, sides)


@pytest.fixture(scope="module")
def drive() -> Drive:
    return make_drive()


@pytest.mark.parametrize("pair", [(0, 1), (1, 0), (0, 2)])
def test_most_matches_show_the_same_corner(drive: Drive, pair: tuple[int, int]) -> None:
    found = drive.match(*pair)
    assert len(found.first) > 100
    assert np.mean(drive.errors_px(*pair, found) < 2.0) > 0.95


def test_matches_are_one_to_one_and_the_same_both_ways(drive: Drive) -> None:
    there, back = drive.match(0, 1), drive.match(1, 0)
    assert len(set(there.second.tolist())) == len(there.second)
    pairs = set(zip(there.first.tolist(), there.second.tolist(), strict=True))
    assert pairs == set(zip(back.second.tolist(), back.first.tolist(), strict=True))


def test_depths_shorten_the_band_and_find_no_fewer(drive: Drive) -> None:
    with_depth = make_drive(with_depth=True)
    found = with_depth.match(0, 2)
    assert len(found.first) > 0.95 * len(drive.match(0, 2).first)
    assert np.mean(with_depth.errors_px(0, 2, found) < 2.0) > 0.98


def test_nothing_matches_off_the_epipolar_line(drive: Drive) -> None:
    wrong = [np.array(pose) for pose in drive.poses]
    wrong[1] = wrong[1] @ se3.exp([0, 0, 0, 0.2, 0, 0])  # looks 52 px too low
    tilted = Drive(wrong, drive.sides)
    assert len(tilted.match(0, 1).first) < 0.05 * len(drive.match(0, 1).first)


def test_nothing_matches_at_a_turn_that_the_poses_do_not_foresee(drive: Drive) -> None:
    turned = drive.sides[1]._replace(angle_rad=drive.sides[1].angle_rad + np.float32(1.0))
    other = Drive(drive.poses, [drive.sides[0], turned])
    assert len(other.match(0, 1).first) < 5


def test_a_corner_with_a_double_further_along_the_line_is_not_matched(drive: Drive) -> None:
    a, b = drive.sides[0], drive.sides[1]
    found = drive.match(0, 1)
    i, j = int(found.first[0]), int(found.second[0])
    for shift, expected in ((30.0, 0), (1.0, 1)):  # the same corner of another octave may stay
        twice = [j, j]
        pixels = b.pixels[twice] + np.array([[0, 0], [-shift, 0]], np.float32)
        double = b._replace(
            pixels=pixels,
            rays=b.rays[twice],
            bits=b.bits[twice],
            angle_rad=b.angle_rad[twice],
            sigma=b.sigma[twice],
            depth=b.depth[twice],
            depth_sigma=b.depth_sigma[twice],
            orders=np.argsort(pixels, axis=0, kind="stable").T.astype(np.int32, order="C"),
        )
        alone = MatchSide(
            a.pinhole, *(array[i : i + 1] for array in a[1:8]), np.zeros((2, 1), "i4")
        )
        flat = BuildSettings(epipolar_px=12.0)
        T_b_a = se3.inverse(drive.poses[1]) @ drive.poses[0]
        assert len(match(alone, double, T_b_a, flat).first) == expected


def test_a_foreseen_turn_is_allowed() -> None:
    paint, extractor = wall_drive.wall(), OrbExtractor(OrbConfig(max_features=500))
    poses = [np.eye(4), se3.exp([0.1, 0, 0, 0, 0, 0]) @ se3.exp([0, 0, 0, 0, 0, 1.2])]
    sides = []
    for T in poses:
        features = extractor.extract(wall_drive.picture(paint, T), CAMERA)
        none = np.zeros(len(features.pixels))
        sides.append(match_side(features, CAMERA.pinhole, extractor.config, none, none))
    rolled = Drive(poses, sides)
    found = rolled.match(0, 1)
    assert len(found.first) > 60
    assert np.mean(rolled.errors_px(0, 1, found) < 2.0) > 0.9


def test_cameras_back_to_back_match_nothing(drive: Drive) -> None:
    away = [drive.poses[0], drive.poses[1] @ se3.exp([0, 0, 0, 0, np.pi, 0])]
    assert len(Drive(away, drive.sides).match(0, 1).first) == 0


def test_images_without_features_match_nothing(drive: Drive) -> None:
    blank = OrbExtractor(OrbConfig()).extract(np.zeros((240, 320), np.uint8), CAMERA)
    empty = match_side(blank, CAMERA.pinhole, OrbConfig(), np.empty(0), np.empty(0))
    assert len(match(empty, drive.sides[1], np.eye(4), SETTINGS).first) == 0
    assert len(match(drive.sides[1], empty, np.eye(4), SETTINGS).first) == 0
