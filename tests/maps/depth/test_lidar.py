# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.errors import RecordingError
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.reader import open_map
from edge.types import F64
from maps.build import BuildInput, build
from maps.depth.lidar import lidar_depth, read_scan
from maps.settings import BuildSettings
from tests.maps import wall_drive
from tests.maps.wall_drive import CAMERA, WALL_Z_M, poses, write_wall_drive

CAR_CAMERA = CameraModel(620, 188, 359.0, 359.0, 303.5, 92.5)
# The scanner looks along x, left is y, up is z; it sits above and behind the camera.
T_CAM_LIDAR = np.array([[0, -1.0, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
ROAD_Y_M, BOX_Z_M, FRONT_Z_M = 1.6, 12.0, 30.0


def street(directions: F64, origin: F64) -> F64:
    """Distance (n,) along unit directions (n, 3) to a road, a box on it, and a front behind."""
    with np.errstate(divide="ignore", invalid="ignore"):
        road = np.where(directions[:, 1] > 0, (ROAD_Y_M - origin[1]) / directions[:, 1], np.inf)
        front = (FRONT_Z_M - origin[2]) / directions[:, 2]
        box = (BOX_Z_M - origin[2]) / directions[:, 2]
        x, y = (origin[:2] + box[:, None] * directions[:, :2]).T
        hit = (np.abs(x - 1.0) < 1.5) & (y > -0.5) & (y < ROAD_Y_M) & (box > 0)
    nearest = np.minimum(road, np.where(front > 0, front, np.inf))
    return np.where(hit, np.minimum(box, nearest), nearest)


def scan(noise_m: float = 0.02) -> F64:
    """Points (n, 3) as a 64-line scanner sees the street."""
    rng = np.random.default_rng(0)
    elevation = np.deg2rad(np.linspace(-24.8, 2.0, 64))
    azimuth = np.deg2rad(np.arange(-45.0, 45.0, 0.18))
    e, a = (grid.ravel() for grid in np.meshgrid(elevation, azimuth, indexing="ij"))
    directions = np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), axis=1)
    T = T_CAM_LIDAR
    distance = street(directions @ T[:3, :3].T, T[:3, 3])
    distance += rng.normal(0.0, noise_m, len(distance))
    return (directions * distance[:, None])[np.isfinite(distance) & (distance < 80.0)]


def true_depth() -> F64:
    v, u = np.mgrid[: CAR_CAMERA.height, : CAR_CAMERA.width]
    rays = np.column_stack(
        (CAR_CAMERA.normalise(np.column_stack((u.ravel(), v.ravel()))), np.ones(u.size))
    )
    lengths = np.linalg.norm(rays, axis=1)
    return (street(rays / lengths[:, None], np.zeros(3)) / lengths).reshape(u.shape)


def test_a_street_is_dense_and_right_from_one_scan() -> None:
    depth = lidar_depth(scan(), T_CAM_LIDAR, CAR_CAMERA)
    truth = true_depth()
    low = truth[85:]  # the highest laser looks 2 degrees up
    known = depth[85:] > 0.0
    error = np.abs(depth[85:][known] / low[known] - 1.0)
    assert known.mean() > 0.9
    assert np.median(error) < 0.003
    assert np.mean(error < 0.02) > 0.95
    # Known up to the edges of the box, too.
    edges = np.abs(np.diff(truth, axis=1)) > 10.0
    assert edges[90:110].sum() == 40
    assert np.mean(depth[90:110, 1:][edges[90:110]] > 0.0) > 0.8
    # Between box and front there is no third surface in the air.
    between = (depth > BOX_Z_M * 1.1) & (depth < FRONT_Z_M * 0.9) & (truth > FRONT_Z_M * 0.95)
    assert between.mean() < 0.002


def test_nothing_is_made_up_beyond_the_scan() -> None:
    points = scan()
    right = points[points[:, 1] < 0.0]  # y is to the left
    depth = lidar_depth(right, T_CAM_LIDAR, CAR_CAMERA)
    first = np.nanmin(CAR_CAMERA.project(se3.transform(T_CAM_LIDAR, right))[:, 0])
    assert np.count_nonzero(depth[:, : int(first)]) == 0
    assert np.count_nonzero(depth[100:, 330:]) > 20_000
    assert np.count_nonzero(lidar_depth(points[:0], T_CAM_LIDAR, CAR_CAMERA)) == 0


def test_points_of_a_file_are_those_written(tmp_path: Path) -> None:
    rows = np.array([[1, 2, 3, 0.5], [np.nan, 0, 0, 0], [4, 5, 6, 0.1]], "<f4")
    rows.tofile(tmp_path / "a.bin")
    assert read_scan(tmp_path / "a.bin").tolist() == [[1, 2, 3], [4, 5, 6]]
    (tmp_path / "a.bin").write_bytes(rows.tobytes()[:-3])
    with pytest.raises(RecordingError, match=r"a\.bin: 45 bytes are no whole points"):
        read_scan(tmp_path / "a.bin")
    with pytest.raises(RecordingError, match=r"b\.bin: cannot be read"):
        read_scan(tmp_path / "b.bin")


def write_kitti_drive(folder: Path, n: int) -> Path:
    """The wall drive in KITTI's form, with scans of a grid of directions."""
    drive = write_wall_drive(folder / "wall", n)
    root = folder / "sequences" / "00"
    (root / "velodyne").mkdir(parents=True)
    (drive / "rgb").rename(root / "image_0")
    for i in range(n):
        (root / "image_0" / f"{i:04d}.png").rename(root / "image_0" / f"{i:06d}.png")
    (root / "times.txt").write_text("\n".join(f"{0.1 * i:.6f}" for i in range(n)) + "\n")
    P = np.column_stack((np.diag((CAMERA.fx, CAMERA.fy, 1.0)), np.zeros(3)))
    P[:2, 2] = CAMERA.cx, CAMERA.cy
    lines = {"P0": P, "P1": P, "Tr": T_CAM_LIDAR[:3]}
    text = "\n".join(f"{k}: {' '.join(map(str, m.ravel()))}" for k, m in lines.items())
    (root / "calib.txt").write_text(text + "\n")
    (folder / "poses").mkdir()
    T_all = poses(n)
    rows = (" ".join(map(str, T[:3].ravel())) for T in T_all)
    (folder / "poses" / "00.txt").write_text("\n".join(rows) + "\n")
    (root / "image_1").mkdir()
    for path in (root / "image_0").iterdir():
        (root / "image_1" / path.name).write_bytes(path.read_bytes())
    for i, T in enumerate(T_all):
        v, u = np.mgrid[2 : CAMERA.height : 4, 2 : CAMERA.width : 3]
        z = wall_drive.depth(T)[v, u].ravel()
        ideal = CAMERA.normalise(np.column_stack((u.ravel(), v.ravel())))
        points = np.column_stack((ideal, np.ones(len(z)))) * z[:, None]
        in_lidar = se3.transform(se3.inverse(T_CAM_LIDAR), points)
        record = np.column_stack((in_lidar, np.zeros(len(z)))).astype("<f4")
        record.tofile(root / "velodyne" / f"{i:06d}.bin")
    return root


def test_a_build_takes_depths_from_scans(tmp_path: Path) -> None:
    root = write_kitti_drive(tmp_path, 3)
    build(BuildInput([root]), tmp_path / "map", BuildSettings(depth="lidar", lens="given"))
    opened = open_map(tmp_path / "map")
    points = opened.points(np.arange(opened.n_points, dtype=np.int32))
    assert (points.n_views == 1).sum() > 50
    assert np.abs(points.xyz[:, 2] - WALL_Z_M).max() < 0.06
    assert len(opened.depth_samples(1).pixels) > 100


def test_a_recording_without_scans_is_refused(tmp_path: Path) -> None:
    drive = write_wall_drive(tmp_path / "wall", 2)
    with pytest.raises(RecordingError, match="no laser scans; --depth lidar needs velodyne"):
        build(BuildInput([drive]), tmp_path / "map", BuildSettings(depth="lidar"))
