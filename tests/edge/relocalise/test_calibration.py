# SPDX-License-Identifier: Apache-2.0
import dataclasses
import logging

import numpy as np
import pytest

from edge.config.relocalise import RelocaliseConfig
from edge.geometry.camera import CameraModel
from edge.relocalise import calibration, lens
from edge.relocalise.absolute_pose import solve_from
from edge.relocalise.assessment import Solution
from edge.relocalise.calibration import LensError, LensEvidence, LensWatch
from edge.relocalise.correspondences import Correspondences
from edge.types import F64, Mat4
from tests.edge.relocalise.room_matches import LENS, RoomMatches, room_matches

CONFIG = RelocaliseConfig()


def told(
    matches: Correspondences, T_start: Mat4, camera: CameraModel
) -> tuple[Solution, LensEvidence]:
    found = solve_from(T_start, matches, camera.pinhole, CONFIG)
    assert found is not None
    evidence = calibration.evidence(found, matches, camera)
    assert evidence is not None
    return found, evidence


def error(matches: Correspondences, T_start: Mat4, camera: CameraModel = LENS) -> LensError:
    return calibration.error_of([told(matches, T_start, camera)[1]])


def longer(share: float) -> CameraModel:
    return dataclasses.replace(LENS, fx=LENS.fx * (1.0 + share), fy=LENS.fy * (1.0 + share))


def shifted(room: RoomMatches, shift: F64) -> Correspondences:
    """The matches with features shifted in the ideal image [focal lengths]."""
    pixels = room.matches.pixels + shift * (LENS.fx, LENS.fy)
    return room.matches._replace(pixels=pixels)


def bent(room: RoomMatches, corner_share: float) -> Correspondences:
    """The matches as a lens sees them whose corner lies farther out than calibrated."""
    return shifted(room, lens.bent(LENS, LENS.normalise(room.matches.pixels), corner_share))


@pytest.mark.parametrize("seed", range(10))
def test_a_right_lens_is_never_refused(seed: int) -> None:
    room = room_matches(seed, n=60, wrong_share=0.2)
    found = error(room.matches, room.T_map_cam)
    assert not calibration.is_wrong(found, CONFIG)
    assert np.all(np.abs(found.share) < 4.0 * found.sigma)


@pytest.mark.parametrize("share", [-0.1, -0.05, 0.05, 0.1])
def test_a_wrong_focal_length_is_told_with_its_sign(share: float) -> None:
    for seed in range(4):
        room = room_matches(seed)
        found = error(room.matches, room.T_map_cam, longer(share))
        assert found.sure[0] * -share > 0.0
        assert found.share[0] == pytest.approx(-share, abs=0.5 * abs(share))


@pytest.mark.parametrize("corner", [-0.06, 0.06])
def test_a_lens_that_bends_otherwise_is_told_with_its_sign(corner: float) -> None:
    for seed in range(4):
        room = room_matches(seed)
        assert error(bent(room, corner), room.T_map_cam).sure[1] * corner > 0.0


def test_a_turn_while_rows_are_read_is_no_wrong_lens() -> None:
    for seed, turned_rad in enumerate(0.03 * np.vstack((np.eye(3), -np.eye(3)))):
        room = room_matches(seed)
        late = (room.matches.pixels[:, 1:] + 0.5) / LENS.height - 0.5
        ideal = LENS.normalise(room.matches.pixels)
        rolled = shifted(room, late * lens.turned_rows(ideal, turned_rad))
        assert not calibration.is_wrong(error(rolled, room.T_map_cam), CONFIG)


def test_a_wall_seen_straight_tells_no_focal_length() -> None:
    rng = np.random.default_rng(0)
    matches = room_matches(0).matches
    xyz = np.column_stack((rng.uniform(-0.8, 0.8, (200, 2)), np.full(200, 2.0)))
    pixels = xyz[:, :2] / 2.0 * (LENS.fx, LENS.fy) + (LENS.cx, LENS.cy)
    wall = matches._replace(xyz=xyz, pixels=pixels + 0.5 * rng.normal(size=(200, 2)))
    camera = longer(0.05)
    found = solve_from(np.eye(4), wall, camera.pinhole, CONFIG)
    assert found is not None
    assert calibration.evidence(found, wall, camera) is None


def watched(images: list[RoomMatches], camera: CameraModel) -> tuple[LensWatch, int | None]:
    """After how many of the images a watch thought the lens wrong."""
    watch = LensWatch(CONFIG)
    for count, room in enumerate(images, 1):
        watch.add(*told(room.matches, room.T_map_cam, camera))
        if watch.is_wrong:
            return watch, count
    return watch, None


@pytest.mark.parametrize("share", [-0.05, 0.05])
def test_few_images_are_enough_to_refuse_a_wrong_lens(share: float) -> None:
    for first in range(0, 12, 3):
        images = [room_matches(seed) for seed in range(first, first + 3)]
        assert watched(images, longer(share))[1] is not None
        assert watched(images, LENS)[1] is None


def test_several_images_tell_what_one_does_not() -> None:
    images = [room_matches(seed, n=120) for seed in range(16)]
    assert not any(
        calibration.is_wrong(error(room.matches, room.T_map_cam, longer(0.025)), CONFIG)
        for room in images[:4]
    )
    assert watched(images, longer(0.025))[1] is not None
    assert watched(images, LENS)[1] is None


def test_images_from_one_place_are_one_witness() -> None:
    assert watched([room_matches(0, n=120)] * 16, longer(0.025))[1] is None


def test_what_is_sure_of_a_lens_makes_poses_uncertain() -> None:
    room = room_matches(0)
    for share in (0.0, 0.02):
        watch = LensWatch(CONFIG)
        for seed in range(16):
            other = room_matches(seed)
            watch.add(*told(other.matches, other.T_map_cam, longer(share)))
        found, evidence = told(room.matches, room.T_map_cam, longer(share))
        sigma_m = float(np.sqrt(np.trace(watch.doubt(evidence)[:3, :3])))
        off_m = float(np.linalg.norm(found.T_map_cam[:3, 3] - room.T_map_cam[:3, 3]))
        assert sigma_m == 0.0 if share == 0.0 else sigma_m > 0.5 * off_m > 0.01


def test_a_wrong_lens_is_warned_of_once(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        watch, _ = watched([room_matches(seed) for seed in range(3)], longer(0.05))
        assert watch.is_wrong
        assert watch.is_wrong
    assert len(caplog.records) == 1
    assert "too_long" in caplog.text
