# SPDX-License-Identifier: Apache-2.0
"""Reports of a made-up run, for tests of what is written and sent."""

import numpy as np

from edge.geometry import se3
from edge.outputs.report import FixReport, FrameReport, Timing
from edge.types import (
    ChangeEvent,
    DepthSamples,
    Evidence,
    Fix,
    Frame,
    KeyframePose,
    KeyframeResult,
    MapPose,
    Mask,
    Mat4,
    Mat6,
    OdometryState,
    OdometryUpdate,
)

PERIOD_NS = 33_333_333


def covariance(seed: int = 0) -> Mat6:
    """A covariance of about a centimetre and half a degree."""
    A = np.random.default_rng(seed).normal(0.0, 0.01, (6, 6))
    return A @ A.T + 1e-6 * np.eye(6)


def odometry_pose(index: int) -> Mat4:
    """A gentle curve."""
    return se3.exp([0.01 * index, 0.002 * index, 0.0, 0.0, 0.01 * index, 0.0])


def keyframe(index: int, inverse_depth: float = 0.5, sigma: float = 0.001) -> KeyframeResult:
    """A keyframe of 50 points that lie at one depth."""
    pixels = np.random.default_rng(index).uniform(5.0, 40.0, (50, 2)).astype(np.float32)
    depth = DepthSamples(
        pixels,
        np.full(50, inverse_depth, np.float32),
        np.full(50, sigma, np.float32),
    )
    frame = Frame(index, index * PERIOD_NS, np.full((48, 64), 77, np.uint8))
    pose = odometry_pose(index)
    return KeyframeResult(frame, pose, depth, (KeyframePose(index, pose),))


def report(
    index: int,
    *,
    odom_id: int = 1,
    published: bool = True,
    fixes: tuple[FixReport, ...] = (),
    with_keyframe: bool = False,
) -> FrameReport:
    """One tracked frame."""
    update = OdometryUpdate(
        index=index,
        t_ns=index * PERIOD_NS,
        state=OdometryState.TRACKING,
        odom_id=odom_id,
        T_odom_cam=odometry_pose(index),
        quality=0.75,
        keyframe=keyframe(index) if with_keyframe else None,
    )
    T_map_cam = se3.exp([1.0, 2.0, 3.0, 0.0, 0.0, 0.3]) @ odometry_pose(index)
    pose = MapPose(index, index * PERIOD_NS, T_map_cam, T_map_cam, covariance(), 1.0, 2)
    return FrameReport(update, pose if published else None, fixes, Timing(1.0, 2.0, 3.5, 4.0))


def lost(index: int, odom_id: int = 1) -> FrameReport:
    """One frame that could not be tracked."""
    update = OdometryUpdate(index, index * PERIOD_NS, OdometryState.LOST, odom_id)
    return FrameReport(update, None, (), Timing())


def fix(index: int, *, accepted: bool = True) -> FixReport:
    """One attempt."""
    return FixReport(
        Fix(
            index=index,
            t_ns=index * PERIOD_NS,
            odom_id=1,
            T_odom_cam=odometry_pose(index),
            found=accepted,
            reason="ok" if accepted else "few matches",
            candidates=(3, 4),
            matches=120,
            inliers=80 if accepted else 0,
            T_map_cam=np.eye(4) if accepted else None,
            covariance=covariance() if accepted else None,
            ms=12.3456,
        ),
        accepted,
        "ok" if accepted else "few matches",
    )


def change(index: int = 0, mask: Mask | None = None) -> ChangeEvent:
    """Something has come."""
    inside = np.array([[False, True, True], [True, True, False]])
    seen = Evidence(index, index * PERIOD_NS, np.eye(4), mask or Mask(4, 5, inside))
    return ChangeEvent(
        id=index,
        t_ns=index * PERIOD_NS,
        kind="added",
        label="cup",
        score=0.95,
        center_map_m=np.array([1.0, 2.0, 3.0]),
        extent_m=np.array([0.1, 0.1, 0.2]),
        n_views=3,
        log_odds=3.0,
        source="model",
        evidence=(seen,),
    )
