# SPDX-License-Identifier: Apache-2.0
"""The window's normal equations: packing for the kernels, Schur complement, prior."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from edge.config.odometry import OdometryConfig
from edge.odometry import anchors
from edge.odometry import kernels_lens as kl
from edge.odometry import kernels_schur as ks
from edge.odometry import kernels_window as kw
from edge.odometry.kernels_linearise import linearise
from edge.types import F32, F64, I32, U8, Mat4

# A step that moves its unknowns by less than this share of their sigmas is the last one.
SETTLED_SIGMAS = 0.25


class FrameState(Protocol):
    """What the equations need of a keyframe."""

    slot: int
    T_first: Mat4
    affine_first: F64
    delta: F64
    energy_limit: float
    turning: F64
    velocity: F64

    @property
    def T_cam_odom(self) -> Mat4:
        """Current estimate."""

    @property
    def affine(self) -> F64:
        """Current brightness (2,): a, b."""

    def rebase(self) -> None:
        """Make the current estimate the first one."""


def relative_warps(hosts: Sequence[Mat4], targets: Sequence[Mat4] | None = None) -> F64:
    """T_target_host of all pairs, (h, t, 12) [host, target]: R row by row, then t.

    Both are poses T_cam_odom; without `targets` the hosts see one another.
    """
    T = np.array(hosts).reshape(-1, 4, 4)
    T_targets = T if targets is None else np.array(targets)
    R, t = T[:, None, :3, :3], T[:, None, :3, 3:]
    Rr = T_targets[None, :, :3, :3] @ R.swapaxes(-1, -2)
    out = np.empty((*Rr.shape[:2], 12))
    out[..., :9] = Rr.reshape(*Rr.shape[:2], 9)
    out[..., 9:] = (T_targets[None, :, :3, 3:] - Rr @ t)[..., 0]
    return out


def relative_adjoints(warps: F64) -> F64:
    """-Ad(T_target_host) of all pairs, (f, f, 36): how a host's step moves the relative pose."""
    n = len(warps)
    R = warps[..., :9].reshape(n, n, 3, 3)
    t = warps[..., 9:]
    hat = np.zeros((n, n, 3, 3))
    hat[..., 0, 1], hat[..., 0, 2], hat[..., 1, 2] = -t[..., 2], t[..., 1], -t[..., 0]
    hat[..., 1, 0], hat[..., 2, 0], hat[..., 2, 1] = t[..., 2], -t[..., 1], t[..., 0]
    A = np.zeros((n, n, 6, 6))
    A[..., :3, :3] = A[..., 3:, 3:] = R
    A[..., :3, 3:] = hat @ R
    return np.asarray(-A.reshape(n, n, 36))


def relative_affines(now: F64, first: F64) -> F32:
    """Gain, target offset and gain at the first estimates, (f, f, 3) [host, target]."""
    out: F32 = np.empty((len(now), len(now), 3), np.float32)
    out[..., 0] = np.exp(now[None, :, 0] - now[:, None, 0])
    out[..., 1] = now[None, :, 1]
    out[..., 2] = np.exp(first[None, :, 0] - first[:, None, 0])
    return out


@dataclass(slots=True, eq=False)
class Packing:
    """Points sorted by host, padded to whole blocks, with the kernels' results beside them."""

    order: I32  # (n,) where each packed lane comes from, -1 for padding
    block_host: I32
    points: F32
    active: U8
    state: U8
    energy: F32
    sums: F64
    W: F32
    Hd: F32
    bd: F32
    anchor: F32  # (2, n)

    @property
    def inliers(self) -> int:
        """Residuals that count, at least one."""
        return max(int(np.count_nonzero(self.state == kw.INLIER)), 1)

    def variance(self, energy: float, config: OdometryConfig) -> float:
        """Variance [grey^2] of a residual of weight one, by the energy of all."""
        return config.covariance_factor * energy / self.inliers / kw.PATTERN_SIZE

    @property
    def settled_chi2(self) -> float:
        """Gain of a step [squared sigmas] below which its unknowns are as good as they will be.

        Energies are no more exact: residuals that come and go move them as much.
        """
        unknowns = 8 * len(self.state) + int(np.count_nonzero(self.order >= 0))
        return SETTLED_SIGMAS**2 * unknowns

    def seen_by(self, target: int) -> "Packing":
        """The same, with the residuals of one target frame alone to take part."""
        only = np.arange(len(self.active))[:, None] == target
        return replace(self, active=self.active * only)

    def energy_of(self, target: int) -> F32:
        """Energies of the residuals that the target frame sees."""
        seen = (self.state[target] == kw.INLIER) | (self.state[target] == kw.OUTLIER)
        return np.asarray(self.energy[target, seen])


class WindowSystem:
    """Runs the window kernels. Owned by the thread of the keyframe work."""

    def __init__(self, images: F32, mask: U8, intrinsics: F32, config: OdometryConfig) -> None:
        self._images, self._mask, self._intrinsics = images, mask, intrinsics
        self._huber = np.float32(config.huber_grey)
        self._gradient_scale = np.float32(config.gradient_scale_grey)
        self._scratch = np.zeros(kw.SCRATCH_ROWS * kw.BLOCK, np.float32)
        # First estimates, and what follows from them: all steps of an optimisation share these.
        self._first: list[Mat4] = []
        self._warps: F32 = np.zeros((0, 0, 12), np.float32)
        self._adjoint: F32 = np.zeros((0, 0, 36), np.float32)
        self._affine: F32 = np.zeros((0, 0, 3), np.float32)

    def pack(
        self,
        points: F32,
        host: I32,
        residual: U8,
        keyframes: Sequence[FrameState],
        anchor: F32 | None = None,
    ) -> Packing:
        """Sort and pad points (20, n) with hosts (n,), residual states (f, n), anchors (2, n)."""
        f = len(keyframes)
        parts, hosts = [], []
        for h in range(f):
            mine = np.flatnonzero(host == h)
            blocks = -(-len(mine) // kw.BLOCK)
            padded = np.full(blocks * kw.BLOCK, -1, np.int32)
            padded[: len(mine)] = mine
            parts.append(padded)
            hosts.append(np.full(blocks, h, np.int32))
        order = np.concatenate(parts) if parts else np.zeros(0, np.int32)
        real = order >= 0
        n = len(order)
        table = np.zeros((kw.POINT_ROWS, n), np.float32)
        table[:, real] = points[:, order[real]]
        held: F32 = np.zeros((2, n), np.float32)
        if anchor is not None:
            held[:, real] = anchor[:, order[real]]
        active = np.zeros((f, n), np.uint8)
        active[:, real] = residual[:, order[real]] == kw.INLIER
        return Packing(
            order=order,
            block_host=np.concatenate(hosts) if hosts else np.zeros(0, np.int32),
            points=table,
            active=active,
            state=np.zeros((f, n), np.uint8),
            energy=np.zeros((f, n), np.float32),
            sums=np.zeros((f, f, kw.N_SUMS)),
            W=np.zeros((8 * f, n), np.float32),
            Hd=np.zeros(n, np.float32),
            bd=np.zeros(n, np.float32),
            anchor=held,
        )

    def linearise(self, packing: Packing, keyframes: Sequence[FrameState]) -> float:
        """Fill the packing's sums at the current state; the energy, outliers at their limit."""
        warps_first = self._warps_first(keyframes)
        warps = relative_warps([k.T_cam_odom for k in keyframes])
        now = np.stack([k.affine for k in keyframes])
        first = np.stack([k.affine_first for k in keyframes])
        self._affine = relative_affines(now, first)
        energy = linearise(
            self._images,
            self._mask,
            np.array([k.slot for k in keyframes], np.int32),
            packing.block_host,
            packing.points,
            self._intrinsics,
            warps.astype(np.float32),
            warps_first,
            self._affine,
            np.stack((first[:, 1], now[:, 1])).astype(np.float32),
            np.array([k.energy_limit for k in keyframes], np.float32),
            self._huber,
            self._gradient_scale,
            self._adjoint,
            packing.active,
            self._scratch,
            packing.state,
            packing.energy,
            packing.sums,
            packing.W,
            packing.Hd,
            packing.bd,
        )
        return energy + anchors.add(
            packing.anchor, packing.points[kw.IDEPTH], packing.Hd, packing.bd
        )

    def _warps_first(self, keyframes: Sequence[FrameState]) -> F32:
        """Warps (f, f, 12) at the first estimates, with `_adjoint` beside them."""
        first = [k.T_first for k in keyframes]
        # They are replaced, never changed in place.
        same = len(first) == len(self._first)
        if not same or any(a is not b for a, b in zip(first, self._first, strict=True)):
            warps = relative_warps(first)
            self._first, self._warps = first, warps.astype(np.float32)
            self._adjoint = relative_adjoints(warps).astype(np.float32)
        return self._warps

    def lens(self, packing: Packing, keyframes: Sequence[FrameState]) -> tuple[F64, F64, F64]:
        """Information (5, 5), gradient (5,) of the lens, and (5, 8 f) with the frames.

        The depths are eliminated. Follows `linearise` at the same state.
        """
        H, b, H_frames, H_depths = self.lens_columns(packing, keyframes)
        carry = H_depths / np.maximum(packing.Hd, ks.MIN_DEPTH_HESSIAN)
        carry[:, packing.Hd <= ks.MIN_DEPTH_HESSIAN] = 0.0
        return H - carry @ H_depths.T, b - carry @ packing.bd, H_frames - carry @ packing.W.T

    def lens_columns(
        self, packing: Packing, keyframes: Sequence[FrameState]
    ) -> tuple[F64, F64, F64, F32]:
        """Results of `kernels_lens.lens_system`; the last is with the depths, (5, n)."""
        f, n = len(keyframes), packing.points.shape[1]
        warps_first = self._warps_first(keyframes)
        warps = relative_warps([k.T_cam_odom for k in keyframes]).astype(np.float32)
        offsets = [[k.affine_first[1] for k in keyframes], [k.affine[1] for k in keyframes]]
        H, b = np.empty((kl.N_LENS, kl.N_LENS)), np.empty(kl.N_LENS)
        H_frames = np.empty((kl.N_LENS, 8 * f))
        H_depths = np.empty((kl.N_LENS, n), np.float32)
        kl.lens_system(
            self._images, np.array([k.slot for k in keyframes], np.int32), packing.block_host,
            packing.points, packing.state, self._intrinsics, warps, warps_first, self._affine,
            np.array(offsets, np.float32), self._huber, self._gradient_scale, self._adjoint,
            np.stack([k.turning for k in keyframes]).astype(np.float32),
            np.stack([k.velocity for k in keyframes]).astype(np.float32),
            H, b, H_frames, H_depths,
        )  # fmt: skip
        return H, b, H_frames, H_depths

    def reduced(
        self, packing: Packing, keyframes: Sequence[FrameState], damping: float
    ) -> tuple[F64, F64]:
        """Normal equations (8 f, 8 f), (8 f,) of the frames, the depths eliminated."""
        f = len(keyframes)
        H, b = np.empty((8 * f, 8 * f)), np.empty(8 * f)
        ks.stitch(packing.sums, self._adjoint, self._affine, H, b)
        scaled = np.empty_like(packing.W)
        ks.eliminate_depths(packing.W, packing.Hd, packing.bd, np.float32(damping), scaled, H, b)
        return H, b

    def apply(
        self, packing: Packing, keyframes: Sequence[FrameState], dx: F64, damping: float
    ) -> None:
        """Add the step dx (8 f,) and the depths' steps."""
        steps = np.empty_like(packing.Hd)
        ks.depth_steps(
            packing.W, packing.Hd, packing.bd, dx.astype(np.float32), np.float32(damping), steps
        )
        packing.points[kw.IDEPTH] += steps
        for i, keyframe in enumerate(keyframes):
            keyframe.delta = keyframe.delta + dx[8 * i : 8 * i + 8]

    @staticmethod
    def unpack(packing: Packing, points: F32, residual: U8, information: F32) -> None:
        """Write depths, residual states and depth information back to the unpacked tables."""
        real = packing.order >= 0
        at = packing.order[real]
        points[kw.IDEPTH, at] = packing.points[kw.IDEPTH, real]
        residual[:, at] = packing.state[:, real]
        information[at] = packing.Hd[real]
