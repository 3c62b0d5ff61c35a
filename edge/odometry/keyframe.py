# SPDX-License-Identifier: Apache-2.0
"""A keyframe of the window: its state, and how its image was made."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edge.geometry import se3
from edge.image.pyramid import AS_IT_IS, STILL, Undistortion
from edge.odometry import kernels_window as kw
from edge.odometry.kernels_trace import HIGH, LOW
from edge.types import F32, F64, Frame, Mat4

# Energy beyond which a residual is an outlier before a frame has statistics of its own.
FIRST_ENERGY_LIMIT = float(kw.PATTERN_SIZE * 12 * 12)
# Brightness of a keyframe may drift, but not without reason: inverse variances of a and b
# [1/1, 1/grey^2], in residual energy; small beside what a hundred points say.
BRIGHTNESS_PRIOR = (50.0, 0.05)


@dataclass(slots=True, eq=False)
class Keyframe:
    """One frame of the window. Owned by the thread of the keyframe work."""

    frame: Frame
    slot: int  # in the window's image store
    T_first: Mat4  # T_cam_odom at the first estimate
    affine_first: F64  # (2,) a, b there
    undistortion: Undistortion = AS_IT_IS  # that its image was made with
    gain: F32 | None = None  # (h, w) that freed it of soft shades
    # (3,) each: angular rate that was taken off its rows [rad/s], and velocity as in `Rates`.
    turning: F64 = field(default_factory=lambda: STILL)
    velocity: F64 = field(default_factory=lambda: STILL)
    delta: F64 = field(default_factory=lambda: np.zeros(8))  # twist and affine since then
    energy_limit: float = FIRST_ENERGY_LIMIT
    candidates: F32 = field(default_factory=lambda: np.zeros((kw.POINT_ROWS + 10, 0), np.float32))
    leaving: bool = False
    waits: bool = False  # for masks of what moves: until then its candidates are not used
    is_clear: bool = False  # such masks have come
    # The estimate, and what it was made of: it is asked for far more often than it changes.
    _made: tuple[F64, Mat4, Mat4] | None = None

    @property
    def T_cam_odom(self) -> Mat4:
        """Current estimate. `delta` and `T_first` are replaced, never changed in place."""
        if (
            self._made is None
            or self._made[0] is not self.delta
            or self._made[1] is not self.T_first
        ):
            T = se3.exp(self.delta[:6]) @ self.T_first
            T.flags.writeable = False
            self._made = self.delta, self.T_first, T
        return self._made[2]

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


def held_brightness(keyframes: Sequence[Keyframe]) -> tuple[float, F64, F64]:
    """Energy of what holds the brightness, its information (8 f,) and its gradient (8 f,)."""
    weights, values = np.zeros((2, len(keyframes), 8))
    weights[:, 6:] = BRIGHTNESS_PRIOR
    values[:, 6:] = [k.affine for k in keyframes]
    gradient = (weights * values).ravel()
    return float((weights * values**2).sum()), weights.ravel(), gradient


def energy_limit_of(energies: F32) -> float:
    """Outlier limit of a new frame, from the 70 % quantile of its residuals' energies (n,)."""
    if len(energies) == 0:
        return FIRST_ENERGY_LIMIT
    root = float(np.sqrt(np.quantile(energies, 0.7)))
    return (0.5 * 26.0 + 0.5 * 1.5 * root) ** 2


def rescale(keyframes: list[Keyframe], factor: float) -> None:
    """Scale all places and candidates' depths about the newest camera."""
    centre = keyframes[-1].T_odom_cam[:3, 3]
    for keyframe in keyframes:
        keyframe.rebase()
        T_odom_cam = keyframe.T_odom_cam
        T_odom_cam[:3, 3] = centre + factor * (T_odom_cam[:3, 3] - centre)
        keyframe.T_first = se3.inverse(T_odom_cam)
        keyframe.candidates[[kw.IDEPTH, LOW, HIGH]] /= np.float32(factor)
