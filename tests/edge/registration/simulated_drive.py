# SPDX-License-Identifier: Apache-2.0
"""A drive of which everything is known: true poses, an odometry of another scale, fixes."""

import math

import numpy as np

from edge.geometry import se3, sim3
from edge.registration.registration import Registration
from edge.registration.verdict import FixVerdict
from edge.types import (
    DepthSamples,
    Fix,
    Frame,
    KeyframePose,
    KeyframeResult,
    MapPose,
    Mat4,
    OdometryState,
    OdometryUpdate,
)

DEPTH_M = 2.0
SIGMA_M, SIGMA_RAD = 0.004, 0.002
FRAME_NS = 33_333_333
KEYFRAME_EVERY = 5
ELSEWHERE = se3.exp([0.4, -0.2, 0.1, 0.1, 0.2, 0.0])


class SimulatedDrive:
    """A camera that walks through a room of 2 m depth; odometry units are `scale` metres."""

    def __init__(
        self,
        n_frames: int,
        scale: float = 0.37,
        drift: float = 0.0,
        seed: int = 0,
        odom_id: int = 1,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.rng = rng
        self.scale, self.odom_id = scale, odom_id
        self.T_map_cam = [_pose(n) for n in range(n_frames)]
        S_odom_map = sim3.inverse(sim3.Sim3(scale, *_rotation_translation(rng)))
        self.T_odom_cam = [sim3.transform_pose(S_odom_map, self.T_map_cam[0])]
        for a, b in zip(self.T_map_cam, self.T_map_cam[1:], strict=False):
            step = se3.inverse(a) @ b
            noise = drift * rng.normal(size=6) * np.repeat((np.linalg.norm(step[:3, 3]), 0.002), 3)
            step = se3.exp(noise) @ step
            step[:3, 3] /= scale
            self.T_odom_cam.append(self.T_odom_cam[-1] @ step)

    def update(self, n: int) -> OdometryUpdate:
        reference = n - n % KEYFRAME_EVERY
        keyframe = None
        if n >= 2 and n % KEYFRAME_EVERY == 2:  # its work takes effect two frames later
            keyframe = self._result(reference)
        return OdometryUpdate(
            n,
            n * FRAME_NS,
            OdometryState.TRACKING,
            self.odom_id,
            self.T_odom_cam[n],
            reference,
            se3.inverse(self.T_odom_cam[reference]) @ self.T_odom_cam[n],
            is_keyframe=n % KEYFRAME_EVERY == 0,
            keyframe=keyframe,
        )

    def _result(self, n: int) -> KeyframeResult:
        image = np.zeros((2, 2), np.uint8)
        none = np.zeros(0, np.float32)
        first = max(0, n - 6 * KEYFRAME_EVERY)
        window = tuple(
            KeyframePose(k, self.T_odom_cam[k]) for k in range(first, n + 1, KEYFRAME_EVERY)
        )
        depth = DepthSamples(none.reshape(0, 2), none, none)
        return KeyframeResult(Frame(n, n * FRAME_NS, image), self.T_odom_cam[n], depth, window)

    def fix(
        self,
        n: int,
        offset: Mat4 | None = None,
        *,
        noisy: bool = True,
        with_scale: bool = True,
        support: tuple[int, ...] = (1, 2, 3),
        sigmas: float = 1.0,
    ) -> Fix:
        """A fix of frame n with honest noise; `offset` makes it wrong."""
        sigma = sigmas * np.repeat((SIGMA_M, SIGMA_RAD), 3)
        noise = self.rng.normal(size=6) * sigma if noisy else np.zeros(6)
        T = self.T_map_cam[n].copy()
        T[:3, 3] += noise[:3]
        T[:3, :3] = se3.exp(np.r_[np.zeros(3), noise[3:]])[:3, :3] @ T[:3, :3]
        # Map depths shrink as the fix stands too far ahead.
        ahead = float(noise[:3] @ T[:3, 2]) / DEPTH_M
        log_scale = math.log(self.scale) - ahead + (0.01 * self.rng.normal() if noisy else 0.0)
        return Fix(
            n,
            n * FRAME_NS,
            self.odom_id,
            self.T_odom_cam[n],
            True,
            "ok",
            support,
            200,
            150,
            T if offset is None else offset @ T,
            np.diag(sigma**2),
            support,
            log_scale if with_scale else None,
            0.01 if with_scale else None,
            DEPTH_M,
        )


def play(
    drive: SimulatedDrive,
    registration: Registration,
    frames: range,
    fix_every: int = 6,
    delay: int = 0,
    **fix_options: object,
) -> tuple[list[MapPose | None], list[FixVerdict]]:
    poses, verdicts = [], []
    for n in frames:
        poses.append(registration.step(drive.update(n)))
        if (n - delay) % fix_every == 0 and n - delay >= frames.start:
            verdicts.append(registration.accept(drive.fix(n - delay, **fix_options)))
    return poses, verdicts


def error_m(drive: SimulatedDrive, pose: MapPose) -> float:
    return float(np.linalg.norm(pose.T_map_cam[:3, 3] - drive.T_map_cam[pose.index][:3, 3]))


def _rotation_translation(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    T = se3.exp(rng.normal(size=6))
    return T[:3, :3], T[:3, 3]


def _pose(n: int) -> Mat4:
    t = n / 30.0
    xi = [0.6 * t, 0.2 * math.sin(1.7 * t), 0.3 * math.sin(0.9 * t)]
    return se3.exp([*xi, 0.1 * math.sin(2.0 * t), 0.3 * math.sin(0.7 * t), 0.05 * t])
