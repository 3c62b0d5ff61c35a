# SPDX-License-Identifier: Apache-2.0
"""The window: keyframes and points, optimised together, marginalised when they leave.

Photometric bundle adjustment after Engel, Koltun, Cremers, "Direct Sparse Odometry", PAMI 2018. The
state of a keyframe is its T_cam_odom and brightness (a, b), that of a point its inverse depth.
"""

import numpy as np

from edge.config.odometry import OdometryConfig
from edge.image.pyramid import STILL, Pyramid, PyramidBuilder
from edge.odometry import gauge
from edge.odometry import kernels_window as kw
from edge.odometry.keyframe import (
    FIRST_ENERGY_LIMIT,
    Keyframe,
    energy_limit_of,
    held_brightness,
    rescale,
)
from edge.odometry.lens import LensSystem, brightened, moved_pixels
from edge.odometry.line_window import WindowLines
from edge.odometry.motion import Rates
from edge.odometry.prior import MarginalPrior
from edge.odometry.system import Packing, WindowSystem
from edge.types import F32, F64, I32, U8, Bools, Frame, Mat4, Mat6, Pinhole

# Windows of fewer keyframes are asked nothing about the lens.
MIN_LENS_KEYFRAMES = 6


class Window:
    """Keyframes oldest first, and the table of active points.

    points    (20, n) float32, rows as in `kernels_window`
    host      (n,)    int32    index of each point's keyframe
    residual  (f, n)  uint8    state of each point's residual in each keyframe
    misses    (n,)    uint8    newest keyframes in a row that did not see it; 2 when outside
    depth_information (n,) float32  from the last optimisation [1 / inverse depth^2]
    anchor    (2, n)  float32  inverse depth that the map tells, and its information; 0 for none
    """

    def __init__(self, pinhole: Pinhole, mask: U8, config: OdometryConfig) -> None:
        self.pinhole, self.mask, self.config = pinhole, mask, config
        capacity = (config.window_keyframes or 7) + 1
        self.images: F32 = np.zeros((capacity, pinhole.height, pinhole.width, 3), np.float32)
        self.intrinsics = np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy], np.float32)
        self.keyframes: list[Keyframe] = []
        self.prior = MarginalPrior()
        # After the last optimisation: covariance of T_newest_previous, and news of the lens.
        self.covariance: Mat6 | None = None
        self.lens: LensSystem | None = None
        self._system = WindowSystem(self.images, mask, self.intrinsics, config)
        self.lines = WindowLines(pinhole, mask, used=config.window_lines)
        self.clear_points()

    def clear_points(self) -> None:
        """Forget every point."""
        self.points: F32 = np.zeros((kw.POINT_ROWS, 0), np.float32)
        self.host: I32 = np.zeros(0, np.int32)
        self.residual: U8 = np.zeros((len(self.keyframes), 0), np.uint8)
        self.misses: U8 = np.zeros(0, np.uint8)
        self.depth_information: F32 = np.zeros(0, np.float32)
        self.anchor: F32 = np.zeros((2, 0), np.float32)

    def add_keyframe(
        self, frame: Frame, pyramid: Pyramid, T_cam_odom: Mat4, affine: F64, velocity: F64 = STILL
    ) -> Keyframe:
        """Append a keyframe; every active point gets a residual in it."""
        slot = min(set(range(len(self.images))) - {k.slot for k in self.keyframes})
        self.images[slot] = pyramid.levels[0]
        keyframe = Keyframe(
            frame,
            slot,
            T_cam_odom,
            np.array(affine, np.float64),
            pyramid.undistortion,
            pyramid.gain,
            pyramid.turning,
            velocity,
        )
        self.keyframes.append(keyframe)
        row = np.full((1, self.points.shape[1]), kw.INLIER, np.uint8)
        self.residual = np.concatenate((self.residual, row))
        self.prior.grow()
        self.lines.look(keyframe, self.images[slot])
        return keyframe

    def add_points(self, table: F32, host: I32, good: U8, anchor: F32 | None = None) -> None:
        """Append points (20+, n) with residuals where `good` (f, n) says so."""
        anchor = np.zeros((2, len(host)), np.float32) if anchor is None else anchor
        self.anchor = np.concatenate((self.anchor, anchor), axis=1)
        self.points = np.concatenate((self.points, table[: kw.POINT_ROWS]), axis=1)
        self.host = np.concatenate((self.host, host))
        states = np.where(good != 0, kw.INLIER, kw.UNUSED).astype(np.uint8)
        self.residual = np.concatenate((self.residual, states), axis=1)
        self.misses = np.concatenate((self.misses, np.zeros(len(host), np.uint8)))
        # What the map tells is all that is known of a new point.
        self.depth_information = np.concatenate((self.depth_information, anchor[1]))

    def keep_points(self, keep: Bools) -> None:
        """Drop every point where `keep` (n,) is false."""
        self.points = np.ascontiguousarray(self.points[:, keep])
        self.host, self.misses = self.host[keep], self.misses[keep]
        self.residual = np.ascontiguousarray(self.residual[:, keep])
        self.depth_information = self.depth_information[keep]
        self.anchor = np.ascontiguousarray(self.anchor[:, keep])

    def optimise(self, iterations: int) -> float:
        """Gauss-Newton over poses, brightness and depths; mean energy of a residual [grey^2].

        Residuals that end as outliers or outside the image go, and points left with none.
        """
        packing = self._pack(np.ones(len(self.host), np.bool_))
        photometric = self._begin(packing)
        self.lines.pack(self.keyframes)
        for scale2 in self.lines.scales:
            self.lines.cauchy2 = scale2
            photometric = self._descend(packing, photometric, iterations)
        # Without the prior's energy, whose zero means nothing.
        mean = photometric / packing.inliers
        if len(self.keyframes) > 1:
            self._summarise(packing, packing.variance(photometric, self.config))
        self.lines.read_back(self.keyframes, mean)
        self._read_back(packing)
        self.prior.rebase(self.keyframes, len(self.keyframes) - 1)
        return mean

    def _descend(self, packing: Packing, photometric: float, iterations: int) -> float:
        """Levenberg-Marquardt from a linearised state; the photometric energy at its end."""
        energy, damping = self._cost(photometric), 1e-5
        for iteration in range(iterations):
            H, b = self._system.reduced(packing, self.keyframes, damping)
            self.lines.add(self.keyframes, damping, H, b)
            dx = self._solve(H, b, damping, project=iteration > 0 or not self.prior.is_empty)
            deltas = [keyframe.delta for keyframe in self.keyframes]
            backup = packing.points[kw.IDEPTH].copy(), self.lines.state()
            self._system.apply(packing, self.keyframes, dx, damping)
            self.lines.move(dx, damping)
            photometric_new = self._system.linearise(packing, self.keyframes)
            energy_new = self._cost(photometric_new)
            least = packing.settled_chi2 * packing.variance(photometric, self.config)
            settled = iteration >= 1 and abs(energy - energy_new) < least
            if not energy_new <= energy:
                packing.points[kw.IDEPTH] = backup[0]
                self.lines.restore(backup[1])
                for keyframe, delta in zip(self.keyframes, deltas, strict=True):
                    keyframe.delta = delta
                self._system.linearise(packing, self.keyframes)
                if settled or damping >= 1e-1:
                    break
                damping = max(damping * 100, 1e-3)
                continue
            damping = max(damping * 0.1, 1e-5)
            energy, photometric = energy_new, photometric_new
            if settled:
                break
        return photometric

    def _begin(self, packing: Packing) -> float:
        """Linearise, with an outlier limit of the newest frame's own; the energy."""
        newest = len(self.keyframes) - 1
        # What its residuals' energies are, no limit changes.
        self._system.linearise(packing.seen_by(newest), self.keyframes)
        self.keyframes[newest].energy_limit = energy_limit_of(packing.energy_of(newest))
        return self._system.linearise(packing, self.keyframes)

    def _pack(self, chosen: Bools) -> Packing:
        columns = self.points[:, chosen], self.host[chosen], self.residual[:, chosen]
        return self._system.pack(*columns, self.keyframes, self.anchor[:, chosen])

    def _summarise(self, packing: Packing, variance: float) -> None:
        """Covariance of the newest pose, and what the window says of the lens."""
        H, b = self._with_priors(*self._system.reduced(packing, self.keyframes, 0.0))
        seen = gauge.SeenSystem(H, self.keyframes)
        self.covariance = gauge.relative_covariance(seen, self.keyframes, variance)
        self.lens = None
        # The first windows after a start are bent themselves; slips along edges pass for a bend.
        steady = len(self.keyframes) >= MIN_LENS_KEYFRAMES and not self.lines.is_plain
        if self.config.refine_lens and steady and variance > 0.0:
            self.lens = self._lens_system(packing, seen, b, variance)

    def _lens_system(
        self, packing: Packing, seen: gauge.SeenSystem, b: F64, variance: float
    ) -> LensSystem:
        """What is left of the lens's equations after poses, brightness and depths."""
        H_lens, b_lens, H_frames = self._system.lens(packing, self.keyframes)
        carried = seen.form(H_frames, np.column_stack((H_frames.T, b)))
        H, b = H_lens - carried[:, :-1], b_lens - carried[:, -1]
        return LensSystem(H / variance, b / variance)

    def remake(self, builder: PyramidBuilder, iterations: int) -> float:
        """Make all images as `builder` now does, and solve again; how far that moved [paths].

        Points stay on what they show, the path of the keyframes keeps its length: that is
        what was told to the outside. What was marginalised was seen as images were before.
        """
        length, before = gauge.path_length(self.keyframes), gauge.from_newest(self.keyframes)
        self.lines.clear()
        for index, keyframe in enumerate(self.keyframes):
            self._remake(index, builder)
            keyframe.rebase()
        self.prior = MarginalPrior(len(self.keyframes))
        self.optimise(iterations)
        factor = length / max(gauge.path_length(self.keyframes), 1e-9)
        rescale(self.keyframes, factor)
        self.points[kw.IDEPTH] /= np.float32(factor)
        self.depth_information *= np.float32(factor**2)
        self.anchor *= np.array([[1.0 / factor], [factor**2]], np.float32)
        moved = np.linalg.norm(gauge.from_newest(self.keyframes) - before, axis=1)
        return float(np.mean(moved)) / max(length, 1e-9)

    def correct_rates(self, index: int, rates: Rates, builder: PyramidBuilder) -> None:
        """Take what is now known of a keyframe's motion off its rows."""
        keyframe = self.keyframes[index]
        keyframe.velocity = rates.velocity
        before, keyframe.turning = keyframe.turning, rates.turning
        if keyframe.undistortion.readout_s != 0.0:
            self._remake(index, builder, before)

    def _remake(self, index: int, builder: PyramidBuilder, turning: F64 | None = None) -> None:
        """Make one image anew; `turning` is what was taken off its rows before."""
        keyframe = self.keyframes[index]
        pyramid = builder.build(keyframe.frame.image, keyframe.turning)
        self.images[keyframe.slot] = pyramid.levels[0]
        before, after = keyframe.undistortion, pyramid.undistortion
        gains = keyframe.gain, pyramid.gain
        if before.even_light != after.even_light:  # what is usual was so in other light
            keyframe.energy_limit = FIRST_ENERGY_LIMIT
        keyframe.undistortion, keyframe.gain = after, pyramid.gain
        turned = before.readout_s * (keyframe.turning if turning is None else turning)
        change = after.radial - before.radial, after.readout_s * keyframe.turning - turned
        at, p = [kw.U, kw.V], self.pinhole
        mine = self.host == index
        self.points[np.ix_(at, mine)] = moved_pixels(self.points[np.ix_(at, mine)], p, *change)
        keyframe.candidates[at] = moved_pixels(keyframe.candidates[at], p, *change)
        brighter = p, after.falloff - before.falloff, gains
        self.points[:, mine] = brightened(self.points[:, mine], *brighter)
        keyframe.candidates = brightened(keyframe.candidates, *brighter)

    def _with_priors(self, H: F64, b: F64) -> tuple[F64, F64]:
        _, weights, gradient = held_brightness(self.keyframes)
        return (
            H + np.diag(weights) + self.prior.H,
            b + gradient + self.prior.gradient(self.keyframes),
        )

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
        held = self.prior.energy(self.keyframes) + held_brightness(self.keyframes)[0]
        return photometric + held + self.lines.cost(self.keyframes)

    def _solve(self, H: F64, b: F64, damping: float, *, project: bool) -> F64:
        H, b = self._with_priors(H, b)
        if self.prior.is_empty:
            # Nothing holds the odometry frame yet: the first keyframe does.
            H[range(6), range(6)] += 1e8 * max(float(np.max(np.diag(H)[:6])), 1.0)
        H[np.diag_indices_from(H)] *= 1.0 + damping
        size = 1.0 / np.sqrt(np.maximum(np.diag(H), 0.0) + 10.0)
        try:
            dx = -size * np.linalg.solve(H * size[:, None] * size[None, :], b * size)
        except np.linalg.LinAlgError:
            return np.zeros(len(b))  # where nothing holds a frame, no step is better than any
        if project and not self.prior.is_empty:
            # Where the map holds depths, the scale is seen.
            N = gauge.null_directions(self.keyframes)[:, : 6 if np.any(self.anchor[1]) else 7]
            Q, _ = np.linalg.qr(N)
            dx = dx - Q @ (Q.T @ dx)
        return np.asarray(dx)

    def marginalise_points(self, chosen: Bools) -> None:
        """Fold the information of the chosen points (n,) bool into the prior and drop them."""
        if np.any(chosen):
            packing = self._pack(chosen)
            self._system.linearise(packing, self.keyframes)
            H, b = self._system.reduced(packing, self.keyframes, 0.0)
            weight = self.config.marginal_weight
            self.prior.add(weight * H, weight * b, self.keyframes)
        self.keep_points(~chosen)

    def marginalise_keyframe(self, index: int) -> None:
        """Remove a keyframe that hosts no points any more, by Schur complement of the prior."""
        _, weights, gradient = held_brightness(self.keyframes)
        mine = np.arange(len(weights)) // 8 == index
        self.prior.add(np.diag(weights * mine), gradient * mine, self.keyframes)
        self.prior.eliminate(index)
        self.lines.freeze(self.keyframes[index])
        del self.keyframes[index]
        self.residual = np.ascontiguousarray(np.delete(self.residual, index, axis=0))
        self.host = np.where(self.host > index, self.host - 1, self.host).astype(np.int32)
