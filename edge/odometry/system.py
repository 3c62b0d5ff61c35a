"""The window's normal equations: packing for the kernels, Schur complement, prior."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.odometry import kernels_window as kw
from edge.types import F32, F64, I32, U8, Mat4, Mat6


class FrameState(Protocol):
    """What the equations need of a keyframe."""

    slot: int
    T_first: Mat4
    affine_first: F64
    delta: F64
    energy_limit: float

    @property
    def T_cam_odom(self) -> Mat4:
        """Current estimate."""

    @property
    def affine(self) -> F64:
        """Current brightness (2,): a, b."""


def relative_warps(poses: Sequence[Mat4]) -> F64:
    """T_target_host of all pairs, (f, f, 12) [host, target]: R row by row, then t."""
    T = np.stack(poses)
    R, t = T[:, :3, :3], T[:, :3, 3]
    Rr = np.einsum("tij,hkj->htik", R, R)
    tr = t[None] - np.einsum("htij,hj->hti", Rr, t)
    return np.asarray(np.concatenate((Rr.reshape(*Rr.shape[:2], 9), tr), axis=2))


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


def null_directions(keyframes: Sequence[FrameState]) -> F64:
    """Directions (8 f, 7) that no image can see: position, orientation, scale of the whole."""
    N = np.zeros((8 * len(keyframes), 7))
    for i, keyframe in enumerate(keyframes):
        T = keyframe.T_first
        N[8 * i : 8 * i + 6, :6] = se3.adjoint(T)
        N[8 * i : 8 * i + 3, 6] = T[:3, 3]
    return np.asarray(N / np.maximum(np.linalg.norm(N, axis=0), 1e-12))


def relative_covariance(H: F64, keyframes: Sequence[FrameState], variance: float) -> Mat6 | None:
    """Covariance (6, 6) of the newest keyframe's T_newest_previous, as a twist on its left.

    H (8 f, 8 f) is the window's information without its depths, `variance` that
    of a residual of weight one [grey^2]. What no image can see is held fixed:
    the window as a whole, and its scale. None where too little holds the window.
    """
    Q, _ = np.linalg.qr(null_directions(keyframes))
    seen = np.eye(len(H)) - Q @ Q.T
    size = 1.0 / np.sqrt(np.maximum(np.diag(H), 0.0) + 10.0)
    # With the unseen directions made stiff, the inverse is that on the seen ones.
    stiff = seen @ H @ seen + float(np.max(np.diag(H))) * (Q @ Q.T)
    # Rounding in float32 sums can leave a weak direction slightly negative; this exceeds it.
    scaled = stiff * size[:, None] * size[None, :] + 1e-6 * np.eye(len(H))
    previous, newest = keyframes[-2], keyframes[-1]
    J = np.zeros((6, len(H)))
    T_newest_previous = newest.T_first @ se3.inverse(previous.T_first)
    J[:, -16:-10] = -se3.adjoint(T_newest_previous)
    J[:, -8:-2] = np.eye(6)
    J = J @ seen
    J = J * size
    covariance = variance * J @ np.linalg.solve(scaled, J.T)
    if not np.all(np.isfinite(covariance)):
        return None
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    # What rounding still left at or below zero is as good as the rest, not better.
    values = np.maximum(values, 1e-6 * values[-1])
    return np.asarray((vectors * values) @ vectors.T)


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
        self._adjoint: F32 = np.zeros((0, 0, 36), np.float32)
        self._affine: F32 = np.zeros((0, 0, 3), np.float32)

    def pack(
        self, points: F32, host: I32, residual: U8, keyframes: Sequence[FrameState]
    ) -> Packing:
        """Sort and pad points (20, n) with their hosts (n,) and residual states (f, n)."""
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
        )

    def linearise(self, packing: Packing, keyframes: Sequence[FrameState]) -> float:
        """Fill the packing's sums at the current state; the energy, outliers at their limit."""
        warps_first = relative_warps([k.T_first for k in keyframes])
        warps = relative_warps([k.T_cam_odom for k in keyframes])
        now = np.stack([k.affine for k in keyframes])
        first = np.stack([k.affine_first for k in keyframes])
        self._adjoint = relative_adjoints(warps_first).astype(np.float32)
        self._affine = relative_affines(now, first)
        return kw.linearise(
            self._images,
            self._mask,
            np.array([k.slot for k in keyframes], np.int32),
            packing.block_host,
            packing.points,
            self._intrinsics,
            warps.astype(np.float32),
            warps_first.astype(np.float32),
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

    def reduced(
        self, packing: Packing, keyframes: Sequence[FrameState], damping: float
    ) -> tuple[F64, F64]:
        """Normal equations (8 f, 8 f), (8 f,) of the frames, the depths eliminated."""
        f = len(keyframes)
        H, b = np.empty((8 * f, 8 * f)), np.empty(8 * f)
        kw.stitch(packing.sums, self._adjoint, self._affine, H, b)
        scaled = np.empty_like(packing.W)
        kw.eliminate_depths(packing.W, packing.Hd, packing.bd, np.float32(damping), scaled, H, b)
        return H, b

    def apply(
        self, packing: Packing, keyframes: Sequence[FrameState], dx: F64, damping: float
    ) -> float:
        """Add the step dx (8 f,) and the depths' steps; root mean square pose step."""
        steps = np.empty_like(packing.Hd)
        kw.depth_steps(
            packing.W, packing.Hd, packing.bd, dx.astype(np.float32), np.float32(damping), steps
        )
        packing.points[kw.IDEPTH] += steps
        for i, keyframe in enumerate(keyframes):
            keyframe.delta = keyframe.delta + dx[8 * i : 8 * i + 8]
        poses = dx.reshape(-1, 8)[:, :6]
        return float(np.sqrt(np.mean(poses**2)))

    @staticmethod
    def unpack(packing: Packing, points: F32, residual: U8, information: F32) -> None:
        """Write depths, residual states and depth information back to the unpacked tables."""
        real = packing.order >= 0
        at = packing.order[real]
        points[kw.IDEPTH, at] = packing.points[kw.IDEPTH, real]
        residual[:, at] = packing.state[:, real]
        information[at] = packing.Hd[real]


class MarginalPrior:
    """Quadratic energy on the frames' states, left by what was marginalised.

    H (8 f, 8 f) and b (8 f,), the gradient half at the first estimates.
    """

    def __init__(self) -> None:
        self.H: F64 = np.zeros((0, 0))
        self.b: F64 = np.zeros(0)

    @property
    def is_empty(self) -> bool:
        """Whether nothing was marginalised yet."""
        return not np.any(self.H)

    def grow(self) -> None:
        """Make room for one more frame at the end."""
        n = len(self.b)
        H = np.zeros((n + 8, n + 8))
        H[:n, :n] = self.H
        self.H, self.b = H, np.concatenate((self.b, np.zeros(8)))

    def energy(self, keyframes: Sequence[FrameState]) -> float:
        """Energy at the current state, up to a constant."""
        delta = np.concatenate([k.delta for k in keyframes])
        return float(delta @ self.H @ delta + 2.0 * self.b @ delta)

    def gradient(self, keyframes: Sequence[FrameState]) -> F64:
        """Half of the energy's gradient at the current state."""
        delta = np.concatenate([k.delta for k in keyframes])
        return np.asarray(self.b + self.H @ delta)

    def add(self, H: F64, b_now: F64, keyframes: Sequence[FrameState]) -> None:
        """Add a term whose gradient half at the current state is `b_now`."""
        delta = np.concatenate([k.delta for k in keyframes])
        self.H = self.H + 0.5 * (H + H.T)
        self.b = self.b + b_now - H @ delta

    def eliminate(self, index: int) -> None:
        """Marginalise one frame: Schur complement over its 8 unknowns."""
        gone = np.arange(8 * index, 8 * index + 8)
        kept = np.setdiff1d(np.arange(len(self.b)), gone)
        size = 1.0 / np.sqrt(np.diag(self.H) + 10.0)
        H = self.H * size[:, None] * size[None, :]
        b = self.b * size
        inverse = np.linalg.pinv(0.5 * (H[np.ix_(gone, gone)] + H[np.ix_(gone, gone)].T), 1e-12)
        carry = H[np.ix_(kept, gone)] @ inverse
        H_kept = H[np.ix_(kept, kept)] - carry @ H[np.ix_(gone, kept)]
        b_kept = b[kept] - carry @ b[gone]
        scale = 1.0 / size[kept]
        self.H = 0.5 * (H_kept + H_kept.T) * scale[:, None] * scale[None, :]
        self.b = b_kept * scale
