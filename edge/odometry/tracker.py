# SPDX-License-Identifier: Apache-2.0
"""Finds each frame's pose relative to the newest keyframe, coarse to fine."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.image.pyramid import Pyramid
from edge.odometry import kernels_flow as kf
from edge.odometry import kernels_track as kt
from edge.odometry.plain import Smoother, noise_left
from edge.odometry.reference import Reference, intrinsics_of
from edge.types import F32, F64, U8, Mat4, Mat6, Pinhole

# Steps smaller than this [rad, inverse depths of one] change nothing that a pixel shows.
MIN_STEP = (3e-5, 6e-5, 1e-4, 2e-4, 4e-4, 4e-4)
MAX_ITERATIONS = (10, 15, 20, 30, 30, 30)
# Half turns about the camera's axes that are tried when the constant motion fails [rad].
ROTATION_TRIALS_RAD = (0.02, 0.05)
# Further than this from where the motion led [rad, inverse depths of one] an image may agree by
# chance: no drive's right frame was that far off (0.047), unless frames were missing or it jumped.
STRAY_RAD = 0.05
# ... then so many points must agree. Right ones had 0.78 and more, wrong ones up to that.
STRAY_INLIER_SHARE = 0.8
# Brightness may change by this factor (log) between a keyframe and a frame.
MAX_LOG_GAIN = 1.6
# Brightness: how much a, b may leave what is expected, in residual energy per point.
BRIGHTNESS_WEIGHT = (1e-2, 1e-5)


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """How one frame was tracked."""

    T_cam_reference: Mat4
    affine: F64  # (2,) a, b of the frame, absolute
    residual_grey: float  # root mean square, outliers at the cut-off
    inlier_share: float  # of points in view
    visible_share: float  # of the reference's points
    information: Mat6  # of the twist [1 / grey^2 scaled], level 0
    flow_px2: F64  # mean squared image motion: whole, by translation, by rotation
    strays: bool = False  # far from where the motion led, and few points agree


class Tracker:
    """Photometric tracking against one Reference at a time. Owned by the tracking thread."""

    def __init__(
        self,
        pinholes: Sequence[Pinhole],
        masks: Sequence[U8],
        config: OdometryConfig,
    ) -> None:
        self._intrinsics = [intrinsics_of(p) for p in pinholes]
        self._masks, self._config = masks, config
        self._sums = np.zeros(kt.N_SUMS)
        self._smoother = Smoother()

    def track(
        self,
        pyramid: Pyramid,
        reference: Reference,
        guesses: Iterator[Mat4],
        affine: F64,
        expected_residual: float,
    ) -> Tracked:
        """Best pose over the guesses; later ones are tried only while the result is poor.

        `guesses` are T_cam_reference, most likely first; `affine` (2,) is the
        brightness of the frame before. Poor is a residual above `expected_residual`
        times the configured factor, or few inliers.
        """
        best, foretold = None, None
        images = self._smoother.smoothed(pyramid.levels, reference.smoothing)
        for attempt, guess in enumerate(guesses):
            foretold = guess if foretold is None else foretold
            start = affine if attempt % 2 == 0 else self._matched_brightness(images, reference)
            tried = self._descend(images, reference, guess, start)
            tried = replace(tried, strays=_strays(tried, reference, foretold))
            if best is None or better(tried, best):
                best = tried
            if self._good(best, expected_residual):
                break
        assert best is not None
        return best

    def _good(self, tracked: Tracked, expected: float) -> bool:
        return (
            tracked.residual_grey < expected * self._config.retry_factor
            and tracked.inlier_share > self._config.min_inlier_share
            and not tracked.strays
        )

    def _descend(
        self, images: Sequence[F32], reference: Reference, guess: Mat4, affine: F64
    ) -> Tracked:
        R, t = np.ascontiguousarray(guess[:3, :3]), np.ascontiguousarray(guess[:3, 3])
        relative = np.array([affine[0] - reference.affine[0], affine[1]])
        prior = np.array([0.0, 0.0, *BRIGHTNESS_WEIGHT])
        cutoff = 0.0
        for level in reversed(range(len(images))):
            points = reference.points[level]
            prior[:2] = relative
            cutoff = kt.track_level(
                images[level],
                self._masks[level],
                points,
                points.shape[1],
                self._intrinsics[level],
                R,
                t,
                relative,
                prior,
                np.float32(self._config.huber_grey),
                np.float32(self._config.track_cutoff_grey),
                MAX_ITERATIONS[level],
                MIN_STEP[level],
                self._sums,
            )
        return self._summary(reference, R, t, relative, cutoff)

    def _summary(
        self, reference: Reference, R: F64, t: F64, relative: F64, cutoff: float
    ) -> Tracked:
        sums, points = self._sums, reference.points[0]
        flow = np.empty(4)
        kf.mean_flow(points, points.shape[1], self._intrinsics[0], R, t, flow)
        H, b = np.empty((8, 8)), np.empty(8)
        kt.unpack(sums, H, b)
        seen = max(sums[46], 1.0)
        inliers = sums[45] / seen * min(1.0, self._config.track_cutoff_grey / max(cutoff, 1e-6))
        return Tracked(
            T_cam_reference=se3.from_rotation_translation(R, t),
            affine=np.array([relative[0] + reference.affine[0], relative[1]]),
            residual_grey=math.sqrt(max(sums[44], 0.0) / max(sums[48], 1e-6)),
            inlier_share=float(inliers),
            visible_share=float(sums[46] / max(points.shape[1], 1)),
            # Neighbours share what noise is left: each tells so much less.
            information=noise_left(reference.smoothing) * H[:6, :6],
            flow_px2=flow[:3],
        )

    def _matched_brightness(self, images: Sequence[F32], reference: Reference) -> F64:
        """Affine brightness that makes the coarsest level's mean and spread agree."""
        grey = images[-1][..., 0][self._masks[-1] > 0]
        before = reference.points[-1][3]
        if grey.size == 0 or before.size == 0:
            return np.array(reference.affine)
        a = math.log(max(float(grey.std()), 1.0) / max(float(before.std()), 1.0))
        b = float(grey.mean()) - math.exp(a) * float(before.mean())
        return np.array([a + reference.affine[0], b])


def _strays(tracked: Tracked, reference: Reference, foretold: Mat4) -> bool:
    """Whether a pose far from the foretold one rests on too few points."""
    if tracked.inlier_share >= STRAY_INLIER_SHARE:
        return False
    astray = se3.log(tracked.T_cam_reference @ se3.inverse(foretold))
    moved = float(np.linalg.norm(astray[:3])) * max(reference.inverse_depth, 0.0)
    return max(moved, float(np.linalg.norm(astray[3:]))) > STRAY_RAD


def better(a: Tracked, b: Tracked, times: float = 1.0) -> bool:
    """Whether so many times more of the points agree with `a`, or more closely, than with `b`."""
    return a.inlier_share / (a.residual_grey + 1.0) > times * b.inlier_share / (
        b.residual_grey + 1.0
    )


def motion_guesses(T_cam_reference: Mat4, T_cam_last: Mat4) -> Iterator[Mat4]:
    """Likely T_cam_reference of a new frame, most likely first.

    `T_cam_reference` is the last frame's, `T_cam_last` its motion since the one
    before. Each is given twice in a row: once for each brightness guess.
    """
    constant = T_cam_last @ T_cam_reference
    yield constant
    yield constant
    yield T_cam_reference
    yield se3.exp(0.5 * se3.log(T_cam_last)) @ T_cam_reference
    yield T_cam_last @ constant
    yield np.eye(4)
    for angle in ROTATION_TRIALS_RAD:
        for axis in range(3):
            for sign in (1.0, -1.0):
                turn = np.zeros(6)
                turn[3 + axis] = sign * angle
                yield se3.exp(turn) @ constant


def is_believable(tracked: Tracked, reference: Reference, config: OdometryConfig) -> bool:
    """Whether enough of the reference's points agree with where the frame was tracked to."""
    agreeing = tracked.inlier_share * tracked.visible_share * reference.points[0].shape[1]
    return (
        bool(np.all(np.isfinite(tracked.T_cam_reference)))
        and not tracked.strays
        and tracked.inlier_share > config.min_inlier_share
        and tracked.visible_share > config.min_visible_share
        and agreeing >= config.min_pixels
        # A gain near zero explains any image.
        and abs(tracked.affine[0] - reference.affine[0]) < MAX_LOG_GAIN
    )


def wants_keyframe(
    tracked: Tracked, reference: Reference, size_px: int, config: OdometryConfig
) -> bool:
    """Engel et al. 2018, sec. 3.1: motion, parallax and brightness since the keyframe."""
    whole, translation, _ = np.sqrt(tracked.flow_px2) / size_px
    brightness = abs(tracked.affine[0] - reference.affine[0])
    return bool(
        translation / config.keyframe_translation
        + whole / config.keyframe_motion
        + brightness / config.keyframe_brightness
        > 1.0
        or tracked.visible_share < 0.5
    )


def covariance_of(tracked: Tracked, factor: float) -> Mat6:
    """Covariance of T_reference_cam's twist, from the tracking Hessian."""
    information = tracked.information + 1e-9 * np.eye(6)
    covariance = np.linalg.pinv(information) * (factor * tracked.residual_grey**2)
    Ad = se3.adjoint(se3.inverse(tracked.T_cam_reference))
    return np.asarray(Ad @ covariance @ Ad.T)


def sigma_t_of(covariance: Mat6) -> float:
    """Uncertainty of the place in its worst direction [odometry units]."""
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))


def quality_of(tracked: Tracked) -> float:
    """From 0 (useless) to 1."""
    return float(min(1.0, tracked.inlier_share) * min(1.0, tracked.visible_share / 0.5))


def frozen(array: F64) -> F64:
    """A copy that nobody changes."""
    array = np.array(array, np.float64)
    array.flags.writeable = False
    return array
