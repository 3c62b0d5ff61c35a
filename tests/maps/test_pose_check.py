# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edge.errors import RecordingError
from edge.geometry import se3, so3
from edge.types import F64
from maps.build import BuildInput, build
from maps.settings import BuildSettings
from tests.maps.drive_folder import KnownView, write_drive
from tests.maps.wall_drive import CAMERA, picture, poses, wall

# x right, y down, z forward in place of x right, y up, z backward.
OTHER_AXES = se3.from_rotation_translation(np.diag([1.0, -1.0, -1.0]), np.zeros(3))


def turned(T_world_cam: F64) -> F64:
    """The world's axes turned away from the first camera's, as those of most recordings are."""
    T = se3.from_rotation_translation(
        so3.exp(np.array([1.1, -0.7, 0.4])), np.array([2.0, -1.0, 3.0])
    )
    return T @ T_world_cam


def write(folder: Path, told: Callable[[F64], F64], true: F64) -> Path:
    views = (
        KnownView(picture(wall(), T), told_T, None)
        for T, told_T in zip(true, told(turned(true)), strict=True)
    )
    return write_drive(folder, CAMERA, views, first_s=100.0)


def warnings_of(folder: Path, out: Path, caplog: pytest.LogCaptureFixture) -> list[str]:
    caplog.clear()
    build(BuildInput([folder]), out, BuildSettings(depth="none", similar_views=3))
    return [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize(
    "told",
    [
        lambda T: T @ OTHER_AXES,
        lambda T: np.array([se3.inverse(pose) for pose in T]),
        lambda T: np.roll(T, 2, axis=0),
    ],
    ids=["other axes", "world to camera", "late"],
)
def test_poses_that_the_images_contradict_are_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, told: Callable[[F64], F64]
) -> None:
    (said,) = warnings_of(write(tmp_path / "drive", told, poses(8)), tmp_path / "map", caplog)
    assert "the poses do not fit the images" in said


def test_true_poses_raise_no_doubt(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    drive = write(tmp_path / "drive", lambda T: T, poses(8))
    assert warnings_of(drive, tmp_path / "map", caplog) == []


@pytest.mark.parametrize("n_images", [1, 5])
def test_a_camera_at_rest_raises_no_doubt(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, n_images: int
) -> None:
    drive = write(tmp_path / "drive", lambda T: T, np.repeat(poses(1), n_images, axis=0))
    with pytest.raises(RecordingError, match="no point is seen from two places"):
        warnings_of(drive, tmp_path / "map", caplog)
    assert caplog.records == []
