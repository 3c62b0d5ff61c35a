# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.config import Config, load_config
from edge.config.markers import MarkerPlace, MarkersConfig
from edge.config.printer import to_toml
from edge.errors import ConfigError
from edge.geometry import se3, so3
from edge.markers.pose import believed, corner_points, joint_poses, poses
from edge.relocalise.marker_fixes import MarkerFixes, with_metres
from edge.types import F64, DepthSamples, Fix, Frame, Mat4, Query
from tests.edge.relocalise.marked_drive import NUMBER, SIDE_M, T_MAP_MARKER, frames, settings
from tests.maps.wall_drive import CAMERA, WALL_Z_M

N = 12


def off(fix: Fix, T: Mat4) -> F64:
    assert fix.T_map_cam is not None
    turn = so3.log(fix.T_map_cam[:3, :3] @ T[:3, :3].T)
    return np.concatenate((fix.T_map_cam[:3, 3] - T[:3, 3], turn))


@pytest.fixture(scope="module")
def drive() -> tuple[list[Frame], list[Mat4]]:
    return frames(N)


def test_a_marker_of_known_place_tells_the_pose_at_once(
    drive: tuple[list[Frame], list[Mat4]],
) -> None:
    markers = MarkerFixes(CAMERA, settings(placed=True), has_map=True)
    for frame, T in zip(*drive, strict=True):
        fix, _ = markers.fix(Query(frame))
        assert fix is not None
        assert fix.found
        assert np.linalg.norm(off(fix, T)[:3]) < 0.01
        assert fix.covariance is not None
        assert off(fix, T) @ np.linalg.solve(fix.covariance, off(fix, T)) < 25.0
        assert fix.depth_m == pytest.approx(
            np.linalg.norm(T_MAP_MARKER[:3, 3] - T[:3, 3]), rel=0.02
        )


def test_without_a_map_the_first_marker_is_its_origin(
    drive: tuple[list[Frame], list[Mat4]],
) -> None:
    fix, _ = MarkerFixes(CAMERA, settings(placed=False), has_map=False).fix(Query(drive[0][5]))
    assert fix is not None
    assert np.linalg.norm(off(fix, se3.inverse(T_MAP_MARKER) @ drive[1][5])[:3]) < 0.01


def test_in_a_map_a_marker_without_a_place_tells_metres_only(
    drive: tuple[list[Frame], list[Mat4]],
) -> None:
    frame, T = drive[0][5], drive[1][5]
    rng = np.random.default_rng(1)
    pixels = rng.uniform(0, [CAMERA.width, CAMERA.height], (4000, 2)).astype(np.float32)
    rays = np.column_stack((CAMERA.normalise(pixels.astype(np.float64)), np.ones(len(pixels))))
    depth = (WALL_Z_M - T[2, 3]) / (rays @ T[2, :3])  # metres; the odometry's unit is half of one
    inverse = (0.5 / depth).astype(np.float32)
    samples = DepthSamples(pixels, inverse, np.full(len(pixels), 1e-3, np.float32))
    fix, scale = MarkerFixes(CAMERA, settings(placed=False), has_map=True).fix(
        Query(frame, depth=samples)
    )
    assert fix is None
    assert scale is not None
    assert scale[0] == pytest.approx(np.log(0.5), abs=0.01)
    assert 0.04 <= scale[1] < 0.06


def test_metres_by_a_marker_replace_those_that_are_known_worse() -> None:
    found = Fix(0, 0, None, None, True, "ok", log_scale=0.3, log_scale_sigma=0.05)
    assert with_metres(found, (0.1, 0.04)).log_scale == 0.1
    assert with_metres(found, (0.1, 0.06)).log_scale == 0.3
    assert with_metres(found, None) is found
    assert with_metres(Fix(0, 0, None, None, False, "no pose"), (0.1, 0.04)).log_scale is None


def test_markers_that_nobody_named_are_none_of_ours(drive: tuple[list[Frame], list[Mat4]]) -> None:
    other = msgspec.structs.replace(settings(placed=True), known=(MarkerPlace(number=NUMBER + 1),))
    assert MarkerFixes(CAMERA, other, has_map=False).fix(Query(drive[0][0])) == (None, None)


def test_two_small_markers_together_are_not_ambiguous() -> None:
    """Each alone looks the same from two sides; the way between them does not."""
    pinhole, sigma_px, side_m = CAMERA.pinhole, 0.2, 0.06
    alone, both, wrong = 0, 0, 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        places = [se3.exp([x, 0.1 * x, 0, 0, 0, 0]) for x in (-0.5, 0.5)]
        tilt = se3.exp([0, 0, 0, *rng.uniform(-0.4, 0.4, 2), rng.uniform(-3, 3)])
        T = se3.exp([0, 0, 1.5, 0, 0, 0]) @ np.diag([1.0, -1.0, -1.0, 1.0]) @ tilt
        points = [se3.transform(place, corner_points(side_m)) for place in places]
        seen = []
        for square in points:
            local = se3.transform(T, square)
            exact = CAMERA.denormalise(local[:, :2] / local[:, 2:])
            seen.append(exact + rng.normal(0.0, sigma_px, (4, 2)))
        each = [poses(corners, side_m, pinhole, sigma_px) for corners in seen]
        alone += sum(believed(found) is not None for found in each)
        starts = [
            pose.T_cam_marker @ se3.inverse(place)
            for place, found in zip(places, each, strict=True)
            for pose in found
        ]
        stacked = np.concatenate(points), np.concatenate(seen)
        best = believed(joint_poses(*stacked, starts, pinhole, sigma_px), 2)
        if best is not None:
            both += 1
            wrong += so3.angle(best.T_cam_marker[:3, :3] @ T[:3, :3].T) > 0.15
    assert wrong == 0
    assert both > 40
    assert alone < both


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('family = "4X4_50"\nknown = [{ number = 1 }, { number = 1 }]', "one number"),
        ("known = [{ number = 1 }]", "family is empty"),
        ('family = "4X4_50"\nknown = [{ number = 1, rotation_xyzw = [0, 0, 0, 2] }]', "quaternion"),
        ('family = "4X4_50"\nside_m = 0', "side_m"),
        ('family = "4X4_50"\nknown = [{ number = 1, position_m = [0, 0] }]', "position_m"),
    ],
)
def test_impossible_markers_are_refused(tmp_path: Path, text: str, problem: str) -> None:
    file = tmp_path / "config.toml"
    file.write_text(f"[markers]\n{text}\n")
    with pytest.raises(ConfigError, match=problem):
        load_config(file)


def test_an_unknown_family_is_refused() -> None:
    with pytest.raises(ConfigError, match="family"):
        MarkerFixes(CAMERA, MarkersConfig(family="9X9"), has_map=False)


def test_printed_markers_read_back(tmp_path: Path) -> None:
    config = Config(markers=settings(placed=True))
    file = tmp_path / "config.toml"
    file.write_text(to_toml(config))
    assert load_config(file) == config
    assert load_config(file).markers.side_m == SIDE_M
