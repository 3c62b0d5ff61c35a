# SPDX-License-Identifier: Apache-2.0
"""Writes a run's results to a folder that appears whole or not at all."""

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self, TextIO

import msgspec

from edge.errors import OutputError
from edge.geometry.camera import CameraModel
from edge.outputs import rows
from edge.outputs.point_cloud import PointCloudWriter, map_from_odometry
from edge.outputs.report import FrameReport
from edge.store import durable
from edge.types import ChangeEvent, Mat4

_TEXT_FILES = {
    "poses.tum": "",
    "poses_smooth.tum": "",
    "odometry.tum": "",
    "covariance.csv": rows.COVARIANCE_HEADER,
    "frames.csv": rows.FRAMES_HEADER,
    "fixes.jsonl": "",
    "changes.jsonl": "",
}


def beside(path: Path) -> Path:
    """Where a run goes that was interrupted, if there is a whole one at `path`."""
    return path.with_name(f"{path.name}-interrupted")


class RunFolder:
    """One run's files, written frame by frame; nothing written is revised.

    Until `finish` they lie in a hidden folder beside `path`, which then takes
    the place of an earlier run at `path` as a whole; leaving the `with` block without
    `finish` leaves the earlier run as it was. A run that was interrupted takes the place of
    such a one only, and else lies beside. Owned by the tracking thread.
    """

    def __init__(self, path: Path, camera: CameraModel) -> None:
        self.path = path = path.resolve()
        self._work = path.parent / f".{path.name}.part-{os.getpid()}"
        self._files: dict[str, TextIO] = {}
        self._odometry_name = "odometry.tum"
        self._points: PointCloudWriter | None = None
        with self._reporting():
            _refuse_foreign(path)
            path.parent.mkdir(parents=True, exist_ok=True)
            _remove_leftovers(path)
            self._work.mkdir()
            for name, header in _TEXT_FILES.items():
                self._open(name).write(header)
            self._points = PointCloudWriter(self._work / "points.ply", camera)

    def write(self, report: FrameReport) -> None:
        """Append what `report` adds to each file."""
        with self._reporting():
            self._write_odometry(report)
            self._write_pose(report)
            for fix in report.fixes:
                line = msgspec.json.encode(rows.fix_row(fix)).decode()
                self._files["fixes.jsonl"].write(line + "\n")
            for event in report.changes:
                self._write_change(event)
            self._files["frames.csv"].write(rows.frame(report))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Remove what was written, unless it was finished."""
        self.abort()

    def finish(self, trajectory: Iterable[tuple[int, Mat4]], stats: Mapping[str, Any]) -> Path:
        """Write the final result, close all files and put the folder in its place; return that."""
        if stats.get("interrupted") and is_run_folder(self.path, whole=True):
            self.path = beside(self.path)
            _refuse_foreign(self.path)
        with self._reporting():
            file = self._open("trajectory.tum")
            file.writelines(rows.tum(t_ns, T_map_cam) for t_ns, T_map_cam in trajectory)
            if self._points is not None:
                self._points.close()
            text = msgspec.json.format(msgspec.json.encode(stats), indent=2).decode()
            self._open("stats.json").write(text + "\n")
            for file in self._files.values():
                file.close()
            self._replace()
        return self.path

    def write_change(self, event: ChangeEvent) -> None:
        """Append a change that became sure with none of the frames: after the last."""
        with self._reporting():
            self._write_change(event)

    def _write_change(self, event: ChangeEvent) -> None:
        line = msgspec.json.encode(rows.change_row(event)).decode()
        self._files["changes.jsonl"].write(line + "\n")

    def add(self, name: str, data: bytes) -> None:
        """Put a further file into the folder."""
        with self._reporting():
            (self._work / name).write_bytes(data)

    def abort(self) -> None:
        """Remove what this run has written."""
        closing = [file.close for file in self._files.values()]
        if self._points is not None:
            closing.append(self._points.close)
        for close in closing:
            with suppress(OSError):
                close()
        shutil.rmtree(self._work, ignore_errors=True)

    def _write_odometry(self, report: FrameReport) -> None:
        update = report.update
        if update.T_odom_cam is None:
            return
        name = "odometry.tum" if update.odom_id == 1 else f"odometry-{update.odom_id}.tum"
        if name != self._odometry_name:
            self._files.pop(self._odometry_name).close()
            self._open(name)
            self._odometry_name = name
        self._files[name].write(rows.tum(update.t_ns, update.T_odom_cam))

    def _write_pose(self, report: FrameReport) -> None:
        update, pose = report.update, report.pose
        if pose is None:
            return
        self._files["poses.tum"].write(rows.tum(pose.t_ns, pose.T_map_cam))
        self._files["poses_smooth.tum"].write(rows.tum(pose.t_ns, pose.T_map_cam_smooth))
        self._files["covariance.csv"].write(rows.covariance(pose.t_ns, pose.covariance))
        if self._points and update.keyframe is not None and update.T_odom_cam is not None:
            self._points.add(update.keyframe, map_from_odometry(pose, update.T_odom_cam))

    def _open(self, name: str) -> TextIO:
        # Line by line, so that a long run can be watched.
        file = (self._work / name).open("w", encoding="utf-8", buffering=1)
        self._files[name] = file
        return file

    def _replace(self) -> None:
        for path in self._work.iterdir():
            durable.sync_file(path)
        durable.replace_folder(self._work, self.path)

    @contextmanager
    def _reporting(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.abort()
            raise OutputError(
                f"{self.path}: results cannot be written: {error.strerror or error}; "
                "name another place with --out or make room"
            ) from error


class _Stats(msgspec.Struct):
    """What tells a run's stats.json from any other."""

    frames: int
    fixes_tried: int
    ms: dict[str, Any]
    interrupted: bool = False


def is_run_folder(path: Path, *, whole: bool = False) -> bool:
    """Whether an earlier run wrote `path`; with `whole`, one that was not interrupted."""
    try:
        stats = msgspec.json.decode((path / "stats.json").read_bytes(), type=_Stats)
    except (OSError, msgspec.DecodeError):
        return False
    return (path / "frames.csv").is_file() and not (whole and stats.interrupted)


def _refuse_foreign(path: Path) -> None:
    if path.is_dir():
        if path.samefile("."):
            raise OutputError(
                f"{path}: is the folder that you are in, and a run takes a folder's place: "
                "name a new one with --out"
            )
        if any(path.iterdir()) and not is_run_folder(path):
            raise OutputError(
                f"{path}: exists and is no earlier run: name a new folder with --out, "
                "or remove that one"
            )
    elif path.exists():
        raise OutputError(f"{path}: exists and is no folder: name a new one with --out")


def _remove_leftovers(path: Path) -> None:
    """Remove what killed runs to the same place have left."""
    prefix = f".{path.name}.part-"
    for leftover in path.parent.glob(f"{prefix}*"):
        pid = leftover.name.removeprefix(prefix).removesuffix("-old")
        if not pid.isdigit() or pid == str(os.getpid()) or not Path("/proc", pid).exists():
            shutil.rmtree(leftover, ignore_errors=True)
