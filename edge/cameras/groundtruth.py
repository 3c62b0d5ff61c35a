# SPDX-License-Identifier: Apache-2.0
"""True camera poses of a recording, where it has some."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edge.cameras.tables import I64, read_rows
from edge.errors import RecordingError
from edge.geometry import se3, so3
from edge.types import F64, Mat4

# A pose this close in time stands for the frame itself where it cannot be interpolated.
_SAME_NS = 1_000_000
# Files keep six digits or more; what is off by more is no rotation.
_RIGID_TOLERANCE = 1e-3


class GroundTruth(NamedTuple):
    """Poses at increasing times; they may begin late, end early and have gaps."""

    t_ns: I64  # (m,)
    T_world_cam: F64  # (m, 4, 4)

    @classmethod
    def of(cls, t_ns: I64, poses: Sequence[Mat4]) -> "GroundTruth":
        """Poses (m) of (4, 4) at increasing times (m,)."""
        return cls(t_ns, np.array(poses).reshape(-1, 4, 4))

    def pose_at(self, t_ns: int, max_dt_ns: int = 20_000_000) -> Mat4 | None:
        """Pose (4, 4) at `t_ns`, between its two neighbours; None in a gap and beyond the ends.

        Both neighbours must be within `max_dt_ns`; alone, one within a millisecond will do.
        """
        after = int(np.searchsorted(self.t_ns, t_ns))
        near = [i for i in (after - 1, after) if 0 <= i < len(self.t_ns)]
        near = [i for i in near if abs(int(self.t_ns[i]) - t_ns) <= max_dt_ns]
        if len(near) == 2:
            t0, t1 = (int(self.t_ns[i]) for i in near)
            alpha = (t_ns - t0) / (t1 - t0)
            return se3.interpolate(self.T_world_cam[near[0]], self.T_world_cam[near[1]], alpha)
        if near and abs(int(self.t_ns[near[0]]) - t_ns) <= _SAME_NS:
            return np.array(self.T_world_cam[near[0]])
        return None


def rigid(values: object, where: str) -> Mat4:
    """Pose (4, 4) of its 4 rows, or the upper 3, of 4 numbers; RecordingError if it is none."""
    try:
        rows = np.array(values, np.float64)
    except (TypeError, ValueError):
        rows = np.empty(0)
    if rows.shape not in ((4, 4), (3, 4)):
        raise RecordingError(f"{where}: is no pose of 4 rows of 4 numbers; mend the file")
    R = rows[:3, :3]
    if not np.isfinite(rows).all():
        raise RecordingError(f"{where}: is not finite; remove this pose or mend it")
    bent = float(np.abs(R @ R.T - np.eye(3)).max())
    if bent > _RIGID_TOLERANCE or np.linalg.det(R) < 0.0:
        raise RecordingError(f"{where}: is no rigid transform; remove this pose or mend it")
    return se3.from_rotation_translation(so3.normalise(R), rows[:3, 3])


def read_tum(path: Path) -> GroundTruth:
    """Poses of a table `time_s tx ty tz qx qy qz qw`."""
    rows = list(read_rows(path))
    t_ns = np.array([row.time_ns() for row in rows], np.int64)
    return from_samples(path, t_ns, np.array([row.numbers(1, 8) for row in rows]).reshape(-1, 7))


def from_samples(path: Path, t_ns: I64, samples: F64) -> GroundTruth:
    """Poses of times (m,) and samples (m, 7) tx ty tz qx qy qz qw, put in order of time."""
    if len(t_ns) == 0:
        raise RecordingError(f"{path}: holds no pose; remove the file or give it poses")
    norms = np.linalg.norm(samples[:, 3:], axis=1)
    if (wrong := np.flatnonzero(np.abs(norms - 1.0) > 0.01)).size:
        message = f"{path}: pose {wrong[0]} has a quaternion of length {norms[wrong[0]]:.3g}"
        raise RecordingError(f"{message}; give unit quaternions in the order qx qy qz qw")
    t_ns, order = np.unique(t_ns, return_index=True)
    T = np.tile(np.eye(4), (len(order), 1, 1))
    T[:, :3, :3] = so3.from_quaternion_xyzw(samples[order, 3:])
    T[:, :3, 3] = samples[order, :3]
    return GroundTruth(t_ns, T)
