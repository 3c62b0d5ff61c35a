# SPDX-License-Identifier: Apache-2.0
"""How far a trajectory is from the truth, and on what machine that was found."""

import importlib.metadata
import platform
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.types import F64, OdometryUpdate

MAX_APART_NS = 20_000_000
MIN_POSES = 6  # each half must fix a similarity
ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("numpy", "numba", "opencv-python-headless")


class Similarity(NamedTuple):
    """`truth = s R estimate + t`."""

    s: float
    R: F64
    t: F64

    def apply(self, points: F64) -> F64:
        """Points (n, 3) moved."""
        return np.asarray(self.s * points @ self.R.T + self.t)


class Score(NamedTuple):
    """Errors of positions after the best similarity."""

    n: int
    rmse_m: float
    path_m: float  # of the truth
    drift_scale: float  # scale that fits the second half over that of the first


def umeyama(estimate: F64, truth: F64) -> Similarity:
    """Similarity that takes points (n, 3) onto others with the least squares (Umeyama 1991)."""
    mean_e, mean_t = estimate.mean(axis=0), truth.mean(axis=0)
    e, t = estimate - mean_e, truth - mean_t
    U, d, Vt = np.linalg.svd(t.T @ e)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = (U * sign) @ Vt
    s = float((d * sign).sum() / max(float((e**2).sum()), 1e-18))
    return Similarity(s, R, mean_t - s * R @ mean_e)


def score(
    t_ns: NDArray[np.int64], positions: F64, truth_t_ns: NDArray[np.int64], truth: F64
) -> Score | None:
    """Score positions (n, 3) at times (n,) against true ones (m, 3); None with too few in common.

    Times may run backwards; each pose is compared with the nearest true one.
    """
    order = np.argsort(t_ns, kind="stable")
    t_ns, positions = t_ns[order], positions[order]
    after = np.clip(np.searchsorted(truth_t_ns, t_ns), 1, len(truth_t_ns) - 1)
    before = after - 1
    closer = np.abs(truth_t_ns[before] - t_ns) <= np.abs(truth_t_ns[after] - t_ns)
    nearest = np.where(closer, before, after)
    common = np.abs(truth_t_ns[nearest] - t_ns) <= MAX_APART_NS
    found, true = positions[common], truth[nearest[common]]
    if len(found) < MIN_POSES:
        return None
    error = umeyama(found, true).apply(found) - true
    half = len(found) // 2
    first, second = umeyama(found[:half], true[:half]).s, umeyama(found[half:], true[half:]).s
    return Score(
        n=len(found),
        rmse_m=float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        path_m=float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum()),
        drift_scale=second / first,
    )


def where_measured() -> str:
    """Machine, commit and versions, in one line."""
    commit = _git("rev-parse", "--short", "HEAD") + ("+" if _git("status", "--porcelain") else "")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES)
    return f"{_processor()}; commit {commit}; Python {platform.python_version()}, {versions}"


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.exists() else ():
        if line.startswith(("model name", "Model")):
            return line.partition(":")[2].strip()
    return platform.machine()


def _git(*arguments: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False
    )
    return done.stdout.strip()


class Life(NamedTuple):
    """All frames with a pose in one odometry frame, those that got it afterwards among them."""

    t_ns: NDArray[np.int64]  # (n,)
    places: F64  # (n, 3)


def lives(updates: Iterable[OdometryUpdate]) -> list[Life]:
    """Those of a drive, the longest first."""
    known: dict[int, dict[int, F64]] = {}
    for update in updates:
        life = known.setdefault(update.odom_id, {})
        for pose in () if update.keyframe is None else update.keyframe.followed:
            if pose.t_ns is not None:
                life[pose.t_ns] = pose.T_odom_cam[:3, 3]
        if update.T_odom_cam is not None:
            life[update.t_ns] = update.T_odom_cam[:3, 3]
    found = [
        Life(np.array(sorted(life), np.int64), np.array([life[t_ns] for t_ns in sorted(life)]))
        for life in known.values()
        if life
    ]
    return sorted(found, key=lambda life: len(life.t_ns), reverse=True)
