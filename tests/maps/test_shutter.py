# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.cameras.groundtruth import GroundTruth
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.odometry.motion import Rates
from edge.relocalise.features import Features
from edge.relocalise.lens import lateness
from edge.tiles.index import BowVector
from edge.types import F64, DepthSamples, Mat4
from maps.describe import Description
from maps.lens_fit import Sightings
from maps.shutter import at_once, rates_at, readout_of

CAMERA = CameraModel(
    640, 480, 525.0, 525.0, 320.0, 240.0, distortion_model="radtan", distortion=(0.1, -0.2, 0, 0)
)
RATE_HZ = 30


def pose_at(t_s: float, *, turning: float = 1.0) -> Mat4:
    """A hand that walks past a wall and turns to and fro."""
    turns = turning * np.array((0.06 * np.sin(9.0 * t_s), 0.1 * np.sin(7.0 * t_s), 0.03 * t_s))
    return se3.exp(np.array((0.4 * t_s - 1.0, 0.1 * np.sin(3.0 * t_s), 0.0, *turns)))


def truth(n: int, turning: float) -> GroundTruth:
    t_ns = (np.arange(n) * 1e9 / RATE_HZ).astype(np.int64)
    return GroundTruth(t_ns, np.array([pose_at(t * 1e-9, turning=turning) for t in t_ns]))


def seen_at(readout_s: float, xyz: F64, t_s: float, turning: float) -> F64:
    """Raw pixels (n, 2) of points, each where its own row saw it."""
    rows_s = readout_s * np.linspace(-1.0, 1.0, 17)  # rows beyond the image, too
    poses = [se3.inverse(pose_at(t_s + delay, turning=turning)) for delay in rows_s]
    path = np.array([CAMERA.project(xyz @ T[:3, :3].T + T[:3, 3]) for T in poses])
    if readout_s == 0.0:
        return path[0]
    out = np.empty((len(xyz), 2))
    for i, pixels in enumerate(path.transpose(1, 0, 2)):
        ahead = readout_s * lateness(pixels, CAMERA) - rows_s  # falls along the path
        order = np.argsort(ahead)
        out[i] = [np.interp(0.0, ahead[order], pixels[order, axis]) for axis in (0, 1)]
    return out


def sightings_with(
    readout_s: float, turning: float = 1.0, n_points: int = 300
) -> tuple[Sightings, list[Rates | None]]:
    """Each fifth image of the walk, with the poses of all images' stamps."""
    rng = np.random.default_rng(3)
    xyz = rng.uniform((-1.5, -1.0, 2.0), (1.5, 1.0, 3.5), (n_points, 3))
    poses = truth(76, turning)
    views = np.arange(2, 75, 5)
    stamps = poses.t_ns[views]
    raw = np.array([seen_at(readout_s, xyz, t * 1e-9, turning) for t in stamps])
    raw += rng.normal(0.0, 0.3, raw.shape)
    inside = (raw >= 0.0).all(axis=2) & (raw < (639.0, 479.0)).all(axis=2)
    point, view = np.nonzero(inside.T)
    T_cam_map = np.array([se3.inverse(poses.T_world_cam[v]) for v in views])
    counts = np.bincount(point, minlength=n_points)
    whole = Sightings(
        np.concatenate(([0], np.cumsum(counts))),
        view.astype(np.int32),
        raw[view, point],
        np.full(len(point), 0.3),
        xyz + rng.normal(0.0, 0.01, xyz.shape),
        T_cam_map,
    )
    moving = [rates_at(poses, int(t)) for t in stamps]
    return whole.some(np.flatnonzero(counts >= 3)), moving


@pytest.mark.parametrize("true_s", [0.02, -0.03])
def test_how_long_rows_were_read_is_found(true_s: float) -> None:
    assert readout_of(*sightings_with(true_s), CAMERA) == pytest.approx(true_s, abs=0.002)


def test_images_read_at_once_stay() -> None:
    assert readout_of(*sightings_with(0.0), CAMERA) == 0.0


def test_a_camera_that_stands_and_few_points_tell_nothing() -> None:
    sightings, moving = sightings_with(0.02)
    still: list[Rates | None] = [Rates(np.zeros(3), np.zeros(3)) for _ in moving]
    assert readout_of(sightings, still, CAMERA) == 0.0
    assert readout_of(sightings.some(np.arange(100)), moving, CAMERA) == 0.0


def test_features_and_depths_come_where_the_middle_row_would_have_seen_them() -> None:
    rng = np.random.default_rng(5)
    readout_s, t_s = 0.03, 1.0
    xyz = rng.uniform((-0.8, -0.8, 2.0), (0.0, 0.3, 3.5), (40, 3))
    raw = seen_at(readout_s, xyz, t_s, 1.0)
    T = se3.inverse(pose_at(t_s))
    local = xyz @ T[:3, :3].T + T[:3, 3]
    ideal = CAMERA.undistort_pixels(raw).astype(np.float32)
    moving = rates_at(truth(76, 1.0), round(t_s * 1e9))
    assert moving is not None
    none = np.zeros(40)
    features = Features(
        ideal, np.zeros((40, 32), np.uint8), none.astype(np.uint8), none.astype(np.float32),
        raw.astype(np.float32),
    )  # fmt: skip
    inverse = (1.0 / local[:, 2]).astype(np.float32)
    given = Description(
        features,
        BowVector(np.zeros(0, np.int32), np.zeros(0, np.float32)),
        local[:, 2],
        none,
        DepthSamples(ideal, inverse, inverse),
    )
    moved = at_once(given, CAMERA, moving, readout_s, local[:, 2])
    exact = local[:, :2] / local[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
    before = np.linalg.norm(ideal - exact, axis=1).max()
    for pixels in (moved.features.pixels, moved.samples.pixels):
        assert np.linalg.norm(pixels - exact, axis=1).max() < 0.15 * before
    assert moved.features.raw_pixels is given.features.raw_pixels


def test_poses_far_apart_or_at_one_end_alone_tell_no_motion() -> None:
    poses = truth(10, 1.0)
    assert rates_at(poses, -50_000_000) is None
    assert rates_at(poses, int(poses.t_ns[0])) is not None
    seldom = GroundTruth(poses.t_ns * 10, poses.T_world_cam)
    assert rates_at(seldom, int(seldom.t_ns[4])) is None
