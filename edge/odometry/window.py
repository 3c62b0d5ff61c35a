"""The window: keyframes and points, optimised together, marginalised when they leave.

Photometric bundle adjustment after Engel, Koltun, Cremers, "Direct Sparse
Odometry", PAMI 2018. The state of a keyframe is its T_cam_odom and an affine
brightness (a, b); that of a point its inverse depth in its host.
"""

from dataclasses import dataclass, field

import numpy as np

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.odometry import kernels_window as kw
from edge.odometry.system import (
    MarginalPrior,
    Packing,
    WindowSystem,
    null_directions,
    relative_covariance,
)
from edge.types import F32, F64, I32, U8, Bools, Frame, Mat4, Mat6, Pinhole

# Brightness of a keyframe may drift, but not without reason: inverse variances of a and b
# [1/1, 1/grey^2], in residual energy; small beside what a hundred points say.
BRIGHTNESS_PRIOR = (50.0, 0.05)
# Energy beyond which a residual is an outlier before a frame has statistics of its own.
FIRST_ENERGY_LIMIT = float(kw.PATTERN_SIZE * 12 * 12)


@dataclass(slots=True, eq=False)
class Keyframe:
    """One frame of the window. Owned by the thread of the keyframe work."""

    frame: Frame
    slot: int  # in the window's image store
    T_first: Mat4  # T_cam_odom at the first estimate
    affine_first: F64  # (2,) a, b there
    delta: F64 = field(default_factory=lambda: np.zeros(8))  # twist and affine since then
    energy_limit: float = FIRST_ENERGY_LIMIT
    candidates: F32 = field(default_factory=lambda: np.zeros((kw.POINT_ROWS + 10, 0), np.float32))
    leaving: bool = False

    @property
    def T_cam_odom(self) -> Mat4:
        """Current estimate."""
        return se3.exp(self.delta[:6]) @ self.T_first

    @property
    def T_odom_cam(self) -> Mat4:
        """Current estimate, camera to odometry frame."""
        return se3.inverse(self.T_cam_odom)

    @property
    def affine(self) -> F64:
        """Current brightness (2,): a, b."""
        return np.asarray(self.affine_first + self.delta[6:])

    def rebase(self) -> None:
        """Make the current estimate the first one: nothing was marginalised against it yet."""
        self.T_first, self.affine_first = self.T_cam_odom, self.affine
        self.delta = np.zeros(8)


class Window:
    """Keyframes oldest first, and the table of active points.

    points    (20, n) float32, rows as in `kernels_window`
    host      (n,)    int32    index of each point's keyframe
    residual  (f, n)  uint8    state of each point's residual in each keyframe
    misses    (n,)    uint8    newest keyframes in a row that did not see it; 2 when outside
    depth_information (n,) float32  from the last optimisation [1 / inverse depth^2]
    """

    def __init__(self, pinhole: Pinhole, mask: U8, config: OdometryConfig) -> None:
        self.pinhole, self.mask, self.config = pinhole, mask, config
        capacity = (config.window_keyframes or 7) + 1
        self.images: F32 = np.zeros((capacity, pinhole.height, pinhole.width, 3), np.float32)
        self.intrinsics = np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy], np.float32)
        self.keyframes: list[Keyframe] = []
        self.prior = MarginalPrior()
        self.covariance: Mat6 | None = None  # of T_newest_previous, after the last optimisation
        self._system = WindowSystem(self.images, mask, self.intrinsics, config)
        self.clear_points()

    def clear_points(self) -> None:
        """Forget every point."""
        self.points: F32 = np.zeros((kw.POINT_ROWS, 0), np.float32)
        self.host: I32 = np.zeros(0, np.int32)
        self.residual: U8 = np.zeros((len(self.keyframes), 0), np.uint8)
        self.misses: U8 = np.zeros(0, np.uint8)
        self.depth_information: F32 = np.zeros(0, np.float32)

    def add_keyframe(self, frame: Frame, level0: F32, T_cam_odom: Mat4, affine: F64) -> Keyframe:
        """Append a keyframe; every active point gets a residual in it."""
        taken = {k.slot for k in self.keyframes}
        slot = next(i for i in range(len(self.images)) if i not in taken)
        self.images[slot] = level0
        keyframe = Keyframe(frame, slot, T_cam_odom, np.array(affine, np.float64))
        self.keyframes.append(keyframe)
        row = np.full((1, self.points.shape[1]), kw.INLIER, np.uint8)
        self.residual = np.concatenate((self.residual, row))
        self.prior.grow()
        return keyframe

    def add_points(self, table: F32, host: I32, good: U8) -> None:
        """Append points (20+, n) with residuals where `good` (f, n) says so."""
        self.points = np.concatenate((self.points, table[: kw.POINT_ROWS]), axis=1)
        self.host = np.concatenate((self.host, host))
        states = np.where(good != 0, kw.INLIER, kw.UNUSED).astype(np.uint8)
        self.residual = np.concatenate((self.residual, states), axis=1)
        self.misses = np.concatenate((self.misses, np.zeros(len(host), np.uint8)))
        self.depth_information = np.concatenate(
            (self.depth_information, np.zeros(len(host), np.float32))
        )

    def keep_points(self, keep: Bools) -> None:
        """Drop every point where `keep` (n,) is false."""
        self.points = np.ascontiguousarray(self.points[:, keep])
        self.host, self.misses = self.host[keep], self.misses[keep]
        self.residual = np.ascontiguousarray(self.residual[:, keep])
        self.depth_information = self.depth_information[keep]

    def optimise(self, iterations: int) -> float:
        """Gauss-Newton over poses, brightness and depths; mean energy of a residual [grey^2].

        Residuals that end as outliers or outside the image are removed, and
        points left with none.
        """
        packing = self._system.pack(self.points, self.host, self.residual, self.keyframes)
        newest = self.keyframes[-1]
        newest.energy_limit = FIRST_ENERGY_LIMIT * 4
        self._system.linearise(packing, self.keyframes)
        newest.energy_limit = self._energy_limit(packing.energy_of(len(self.keyframes) - 1))
        energy = self._cost(self._system.linearise(packing, self.keyframes))
        damping = 1e-5
        for iteration in range(iterations):
            H, b = self._system.reduced(packing, self.keyframes, damping)
            dx = self._solve(H, b, damping, project=iteration >= 1 or not self.prior.is_empty)
            backup = packing.points[kw.IDEPTH].copy(), [k.delta.copy() for k in self.keyframes]
            step = self._system.apply(packing, self.keyframes, dx, damping)
            energy_new = self._cost(self._system.linearise(packing, self.keyframes))
            if not energy_new <= energy:
                packing.points[kw.IDEPTH] = backup[0]
                for keyframe, delta in zip(self.keyframes, backup[1], strict=True):
                    keyframe.delta = delta
                self._system.linearise(packing, self.keyframes)
                if damping >= 1e-1:
                    break
                damping = max(damping * 100, 1e-3)
                continue
            damping = max(damping * 0.1, 1e-5)
            energy = energy_new
            if step < 1e-5 and iteration >= 2:
                break
        H, _ = self._system.reduced(packing, self.keyframes, 0.0)
        self._read_back(packing)
        mean = energy / max(int(np.count_nonzero(self.residual == kw.INLIER)), 1)
        if len(self.keyframes) > 1:
            H += np.diag(self._brightness()[1]) + self.prior.H
            variance = self.config.covariance_factor * mean / kw.PATTERN_SIZE
            self.covariance = relative_covariance(H, self.keyframes, variance)
        newest.rebase()
        return mean

    def _read_back(self, packing: Packing) -> None:
        self._system.unpack(packing, self.points, self.residual, self.depth_information)
        newest = self.residual[-1]
        self.points[kw.GOOD_VIEWS] += newest == kw.INLIER
        self.misses[newest == kw.INLIER] = 0
        self.misses[newest == kw.OUTLIER] += 1
        self.misses[newest == kw.OUTSIDE] = 2
        self.residual[self.residual != kw.INLIER] = kw.UNUSED
        sane = np.isfinite(self.points[kw.IDEPTH]) & (self.points[kw.IDEPTH] > 0)
        self.keep_points(np.any(self.residual == kw.INLIER, axis=0) & sane)

    def _cost(self, photometric: float) -> float:
        return photometric + self.prior.energy(self.keyframes) + self._brightness()[0]

    def _brightness(self) -> tuple[float, F64, F64]:
        n = len(self.keyframes)
        weights = np.zeros((n, 8))
        weights[:, 6:] = BRIGHTNESS_PRIOR
        values = np.zeros((n, 8))
        values[:, 6:] = [k.affine for k in self.keyframes]
        gradient = (weights * values).ravel()
        return float((weights * values**2).sum()), weights.ravel(), gradient

    def _solve(self, H: F64, b: F64, damping: float, *, project: bool) -> F64:
        _, weights, gradient = self._brightness()
        H = H + np.diag(weights) + self.prior.H
        b = b + gradient + self.prior.gradient(self.keyframes)
        if self.prior.is_empty:
            # Nothing holds the odometry frame yet: the first keyframe does.
            H[range(6), range(6)] += 1e8 * max(float(np.max(np.diag(H)[:6])), 1.0)
        H[np.diag_indices_from(H)] *= 1.0 + damping
        size = 1.0 / np.sqrt(np.diag(H) + 10.0)
        dx = -size * np.linalg.solve(H * size[:, None] * size[None, :], b * size)
        if project and not self.prior.is_empty:
            N = null_directions(self.keyframes)
            Q, _ = np.linalg.qr(N)
            dx = dx - Q @ (Q.T @ dx)
        return np.asarray(dx)

    @staticmethod
    def _energy_limit(energies: F32) -> float:
        """Outlier limit of a new frame, from the 70 % quantile of its residuals' energies."""
        if len(energies) == 0:
            return FIRST_ENERGY_LIMIT
        root = float(np.sqrt(np.quantile(energies, 0.7)))
        return (0.5 * 26.0 + 0.5 * 1.5 * root) ** 2

    def marginalise_points(self, chosen: Bools) -> None:
        """Fold the information of the chosen points (n,) bool into the prior and drop them."""
        if np.any(chosen):
            packing = self._system.pack(
                self.points[:, chosen], self.host[chosen], self.residual[:, chosen], self.keyframes
            )
            self._system.linearise(packing, self.keyframes)
            H, b = self._system.reduced(packing, self.keyframes, 0.0)
            weight = self.config.marginal_weight
            self.prior.add(weight * H, weight * b, self.keyframes)
        self.keep_points(~chosen)

    def marginalise_keyframe(self, index: int) -> None:
        """Remove a keyframe that hosts no points any more, by Schur complement of the prior."""
        _, weights, gradient = self._brightness()
        at = slice(8 * index, 8 * index + 8)
        extra_H, extra_b = np.zeros_like(self.prior.H), np.zeros_like(self.prior.b)
        extra_H[at, at] = np.diag(weights[at])
        # `add` wants the gradient at the current state.
        extra_b[at] = gradient[at]
        self.prior.add(extra_H, extra_b, self.keyframes)
        self.prior.eliminate(index)
        del self.keyframes[index]
        self.residual = np.ascontiguousarray(np.delete(self.residual, index, axis=0))
        self.host = np.where(self.host > index, self.host - 1, self.host).astype(np.int32)
