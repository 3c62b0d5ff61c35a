# SPDX-License-Identifier: Apache-2.0
"""The whole product on a drive through a simulated room."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.cli import main
from edge.config import Config
from edge.runtime.replay import ReplayJob, replay
from edge.runtime.run_data import errors_against, read_run, read_truth
from tests.world.conftest import World

pytestmark = [pytest.mark.world, pytest.mark.slow]


@pytest.fixture(scope="module")
def run(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    replay(ReplayJob(world.query, out, world.map), Config())
    return out


def rows_without_times(run: Path) -> dict[str, bytes]:
    """Contents of a run without what may differ: stats and durations."""
    contents = {file.name: file.read_bytes() for file in run.iterdir()}
    del contents["stats.json"]
    header, *lines = contents["frames.csv"].decode().splitlines()
    kept = [i for i, name in enumerate(header.split(",")) if not name.endswith("_ms")]
    table = [[line.split(",")[i] for i in kept] for line in lines]
    contents["frames.csv"] = json.dumps(table).encode()
    fixes = [json.loads(line) for line in contents["fixes.jsonl"].splitlines()]
    for fix in fixes:
        del fix["ms"]
    contents["fixes.jsonl"] = json.dumps(fixes).encode()
    return contents


def test_second_drive_is_localised_at_the_maps_scale(world: World, run: Path) -> None:
    data = read_run(run)
    errors = errors_against(read_truth(world.query), data.poses)
    assert len(data.poses.t_ns) > 0.7 * len(data.t_ns)
    assert len(errors.t_ns) == len(data.poses.t_ns)
    assert np.median(errors.position_m) < 0.01  # the room is 6 m wide
    assert errors.position_m.max() < 0.05
    assert np.median(errors.rotation_deg) < 0.2


def test_same_run_gives_the_same_bytes(world: World, run: Path, tmp_path: Path) -> None:
    replay(ReplayJob(world.query, tmp_path / "again", world.map), Config())
    again, first = rows_without_times(tmp_path / "again"), rows_without_times(run)
    assert again.keys() == first.keys()
    assert [name for name in first if again[name] != first[name]] == []


def test_a_recording_file_gives_the_same_bytes(world: World, run: Path, tmp_path: Path) -> None:
    file = tmp_path / "query.mcap"
    assert main(["record", str(world.query), "--out", str(file)]) == 0
    replay(ReplayJob(file, tmp_path / "again", world.map), Config())
    again, first = rows_without_times(tmp_path / "again"), rows_without_times(run)
    assert [name for name in first if again[name] != first[name]] == []


def test_running_changes_no_byte_of_the_map(world: World, tmp_path: Path) -> None:
    def contents() -> dict[Path, bytes]:
        return {file: file.read_bytes() for file in world.map.rglob("*") if file.is_file()}

    before = contents()
    replay(ReplayJob(world.query, tmp_path / "run", world.map, slice(0, 10)), Config())
    assert contents() == before


def test_poses_are_causal(world: World, run: Path, tmp_path: Path) -> None:
    half = len(read_run(run).t_ns) * 2 // 3
    replay(ReplayJob(world.query, tmp_path / "half", world.map, slice(0, half)), Config())
    for name in ("poses.tum", "odometry.tum", "covariance.csv", "poses_smooth.tum"):
        whole = (run / name).read_text()
        assert whole.startswith((tmp_path / "half" / name).read_text()), name


def test_trajectory_holds_every_tracked_frame(world: World, run: Path) -> None:
    def frames(name: str) -> list[str]:
        return [line.split()[0] for line in (run / name).read_text().splitlines()]

    trajectory = (run / "trajectory.tum").read_text().splitlines()
    of_trajectory, of_odometry = frames("trajectory.tum"), frames("odometry.tum")
    at_first = of_trajectory.index(of_odometry[0])  # before: found once the odometry had started
    assert of_trajectory[at_first:] == of_odometry
    assert of_trajectory == sorted(set(of_trajectory), key=float)
    assert len(of_trajectory) > len(frames("poses.tum"))
    truth = read_truth(world.query)
    for line in trajectory:
        seconds, *numbers = line.split()
        T_true = truth.pose_at(int(seconds.replace(".", "")))
        assert T_true is not None
        assert np.linalg.norm(T_true[:3, 3] - np.array(numbers[:3], float)) < 0.05


def test_stats_say_what_the_files_hold(run: Path) -> None:
    stats = json.loads((run / "stats.json").read_text())
    frames = (run / "frames.csv").read_text().splitlines()[1:]
    fixes = [json.loads(line) for line in (run / "fixes.jsonl").read_text().splitlines()]
    assert stats["frames"] == len(frames)
    assert stats["published"] == (run / "poses.tum").read_text().count("\n")
    assert stats["tracked"] == (run / "odometry.tum").read_text().count("\n")
    assert stats["fixes_tried"] == len(fixes)
    assert stats["fixes_accepted"] == sum(fix["accepted"] for fix in fixes) > 0
    assert stats["keyframes"] == sum(line.split(",")[4] == "1" for line in frames) > 0
    first = next(line for line in frames if line.split(",")[10])
    assert stats["first_pose_frame"] == int(first.split(",")[0])
    assert stats["map_bytes"] > 100_000
    assert 0.0 < stats["cpu_s"] < 60.0
    assert 50.0 < stats["peak_rss_mb"] < 2000.0
    assert set(stats["ms"]) >= {"decode", "track", "keyframe", "frame", "relocalise"}
    assert all(set(v) == {"median", "p95", "p99", "max"} for v in stats["ms"].values())


def test_points_lie_on_the_rooms_walls(run: Path) -> None:
    data = (run / "points.ply").read_bytes()
    body = data.partition(b"end_header\n")[2]
    xyz = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)])["xyz"]
    assert len(xyz) > 1000
    low, high = np.percentile(xyz, (5, 95), axis=0)
    assert (low > -4.0).all()
    assert (high < 4.0).all()


def test_backwards_and_with_stride_it_works_too(world: World, tmp_path: Path) -> None:
    job = ReplayJob(world.query, tmp_path / "run", world.map, stride=2, reverse=True)
    replay(job, Config())
    data = read_run(tmp_path / "run")
    assert (np.diff(data.t_ns) == -100_000_000).all()  # every second frame of 20 Hz
    assert len(data.poses.t_ns) > 0.5 * len(data.t_ns)
    errors = errors_against(read_truth(world.query), data.poses)
    assert errors.position_m[:10].max() < 0.05  # the last ones played, where the map is in view


def test_covered_lens_silences_the_pose_at_once_and_only_then(world: World, tmp_path: Path) -> None:
    drive = tmp_path / "drive"
    shutil.copytree(world.query, drive)
    covered = range(45, 55)
    for index in covered:
        cv2.imwrite(str(drive / "rgb" / f"{index:06d}.jpg"), np.zeros((240, 320), np.uint8))
    replay(ReplayJob(drive, tmp_path / "run", world.map), Config())
    data = read_run(tmp_path / "run")
    published = np.isfinite(data.sigma_m)
    assert published[40:45].all()
    assert not published[list(covered)].any()
    assert "tracking" not in {data.states[index] for index in covered}
    assert published[80:].all()
    errors = errors_against(read_truth(world.query), data.poses)
    assert errors.position_m.max() < 0.1


def test_without_a_map_there_is_odometry_only(world: World, tmp_path: Path) -> None:
    stats, _ = replay(ReplayJob(world.query, tmp_path / "run", frames=slice(0, 40)), Config())
    assert stats["published"] == stats["fixes_tried"] == stats["map_bytes"] == 0
    assert stats["tracked"] > 20
    assert (tmp_path / "run" / "trajectory.tum").read_text() == ""
