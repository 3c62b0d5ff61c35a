# SPDX-License-Identifier: Apache-2.0
"""Reads a run folder and compares it with the truth."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.cameras.groundtruth import GroundTruth, read_tum
from edge.cameras.recording import open_recording
from edge.errors import OutputError, RecordingError
from edge.geometry import so3
from edge.outputs.run_folder import is_run_folder
from edge.types import F64

I64 = NDArray[np.int64]


class Poses(NamedTuple):
    """A trajectory: times (n,) and poses (n, 4, 4)."""

    t_ns: I64
    T: F64


class Errors(NamedTuple):
    """How far published poses are from the truth, where there is some."""

    t_ns: I64
    position_m: F64
    rotation_deg: F64


@dataclass(frozen=True, slots=True, eq=False)
class RunData:
    """What a run folder holds, as far as it is drawn."""

    name: str
    poses: Poses
    odometry: tuple[Poses, ...]
    t_ns: I64  # (n,) of all frames in the order of play
    states: list[str]  # (n,)
    sigma_m: F64  # (n,) nan where no pose was published
    fixes: list[dict[str, Any]]
    stats: dict[str, Any]


def read_run(folder: Path) -> RunData:
    """The run in `folder`."""
    if not is_run_folder(folder):
        raise OutputError(f"{folder}: is no run folder; give one that `mapvo replay --out` wrote")
    try:
        frames = list(csv.DictReader((folder / "frames.csv").read_text("utf-8").splitlines()))
        fixes = (folder / "fixes.jsonl").read_text("utf-8").splitlines()
        return RunData(
            name=folder.resolve().name,
            poses=_read_poses(folder / "poses.tum"),
            odometry=tuple(_read_poses(file) for file in sorted(folder.glob("odometry*.tum"))),
            t_ns=np.array([int(row["t_ns"]) for row in frames], np.int64),
            states=[row["state"] for row in frames],
            sigma_m=np.array([float(row["sigma_m"] or "nan") for row in frames]),
            fixes=[json.loads(line) for line in fixes],
            stats=json.loads((folder / "stats.json").read_bytes()),
        )
    except (OSError, ValueError, KeyError) as error:
        raise OutputError(f"{folder}: is a damaged run: {error}; run it again") from error


def read_truth(path: Path) -> GroundTruth:
    """True poses of a recording, or of a TUM file."""
    if path.is_dir():
        truth = open_recording(path).groundtruth
        if truth is None:
            raise RecordingError(f"{path}: has no true poses; give one that has groundtruth.txt")
        return truth
    if not path.is_file():
        raise RecordingError(f"{path}: is missing; give a recording or a TUM file of true poses")
    return read_tum(path)


def errors_against(truth: GroundTruth, poses: Poses) -> Errors:
    """Error of each pose at whose time the truth is known; nothing is aligned."""
    found = []
    for t_ns, T in zip(poses.t_ns.tolist(), poses.T, strict=True):
        if (T_true := truth.pose_at(t_ns)) is not None:
            distance = float(np.linalg.norm(T[:3, 3] - T_true[:3, 3]))
            angle = np.degrees(so3.angle(T[:3, :3] @ T_true[:3, :3].T))
            found.append((t_ns, distance, angle))
    table = np.array(found).reshape(-1, 3)
    return Errors(np.array([row[0] for row in found], np.int64), table[:, 1], table[:, 2])


def _read_poses(path: Path) -> Poses:
    """Poses of a TUM file, which may be empty."""
    if path.stat().st_size == 0:
        return Poses(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    truth = read_tum(path)
    return Poses(truth.t_ns, truth.T_world_cam)
