# SPDX-License-Identifier: Apache-2.0
"""What the tracking thread remembers of the last tracked frame."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from edge.geometry import se3
from edge.image.pyramid import Pyramid
from edge.odometry.map_start import FIRST_RESIDUAL_GREY
from edge.odometry.mapper import MappedKeyframe
from edge.odometry.motion import MAX_INTERVAL_NS
from edge.odometry.reference import Reference
from edge.odometry.tracker import Tracked, motion_guesses
from edge.types import F32, F64, Frame, Mat4, Pinhole

# No camera is further from where its motion led between two frames, in depths of what it sees:
# where the tracking says so, it has slipped.
MAX_LEAP_DEPTHS = 0.2


@dataclass(slots=True, eq=False)
class LastMotion:
    """Where the camera was, how it moved, and how well its image agreed."""

    T_odom_cam: Mat4
    T_cam_last: Mat4  # motion expected over the next `gap` frames
    affine: F64
    residual_grey: float
    gap: int = 1  # frames from the last tracked one to the next
    failures: int = 0
    t_ns: int | None = None  # of the last tracked frame
    interval_ns: int = 0  # between frames
    glance: F32 | None = None  # (h, w) grey of its coarsest level

    @classmethod
    def after_start(cls, mapped: MappedKeyframe, frame: Frame, gap: int) -> "LastMotion":
        """What a start says of the motion up to `frame`, `gap` frames after its last one."""
        if (ahead := mapped.ahead) is not None:
            step = se3.exp(gap * se3.log(ahead.T_cam_last))
            return cls(ahead.T_odom_cam, step, ahead.affine, ahead.residual_grey, gap)
        window, step = mapped.result.window, np.eye(4)
        if len(window) > 1:
            # The motion between the start's keyframes went on while it was worked on.
            since = abs(frame.index - window[-1].index)
            apart = max(abs(window[-1].index - window[-2].index), 1)
            step = se3.inverse(window[-1].T_odom_cam) @ window[-2].T_odom_cam
            step = se3.exp(se3.log(step) * since / apart)
        reference = mapped.reference
        return cls(reference.T_odom_cam, step, reference.affine, FIRST_RESIDUAL_GREY, gap)

    def guesses(self, pyramid: Pyramid, pinhole: Pinhole, reference: Reference) -> Iterator[Mat4]:
        """Likely T_cam_reference of the next frame; `pinhole` is that of its coarsest level."""
        T_cam_reference = se3.inverse(self.T_odom_cam) @ reference.T_odom_cam
        likely = motion_guesses(T_cam_reference, self.T_cam_last)
        yield from itertools.islice(likely, 2)
        if self.glance is not None:
            turned = _turned(self.glance, pyramid.levels[-1][..., 0], pinhole) @ T_cam_reference
            yield from (turned, turned)
        yield from likely

    def catch_up(self, t_ns: int) -> None:
        """Go on to the time of the next frame, where frames before it never came."""
        if self.t_ns is None or self.interval_ns == 0:
            return
        since = round(abs(t_ns - self.t_ns) / self.interval_ns)
        if since > self.gap:
            longest = max(MAX_INTERVAL_NS / self.interval_ns, 1.0)
            further = max(min(since, longest) / self.gap, 1.0)
            self.T_cam_last = se3.exp(further * se3.log(self.T_cam_last))
            self.gap = since

    def leaps(self, tracked: Tracked, reference: Reference) -> bool:
        """Whether the camera cannot have come there since the last frame."""
        T_odom_cam = reference.T_odom_cam @ se3.inverse(tracked.T_cam_reference)
        expected = self.T_odom_cam @ se3.inverse(self.T_cam_last)
        leap = float(np.linalg.norm(T_odom_cam[:3, 3] - expected[:3, 3]))
        return leap * reference.inverse_depth > MAX_LEAP_DEPTHS * min(self.gap, 2)

    def remember(self, T_odom_cam: Mat4, tracked: Tracked, pyramid: Pyramid, t_ns: int) -> None:
        """Take over a newly tracked frame."""
        step = se3.inverse(T_odom_cam) @ self.T_odom_cam
        if self.gap > 1:
            step = se3.exp(se3.log(step) / self.gap)
        elif self.t_ns is not None:
            self.interval_ns = abs(t_ns - self.t_ns)
        self.T_odom_cam, self.T_cam_last = T_odom_cam, step
        self.affine, self.gap, self.failures = tracked.affine, 1, 0
        self.t_ns, self.glance = t_ns, pyramid.levels[-1][..., 0].copy()
        # Follows slowly: what is normal depends on texture and blur.
        self.residual_grey = max(2.0, 0.7 * self.residual_grey + 0.3 * tracked.residual_grey)


def _turned(last: F32, now: F32, pinhole: Pinhole) -> Mat4:
    """T_now_last of a camera that has only turned, by how all of its image has moved.

    Phase correlation (Kuglin and Hines 1975), to half a pixel of these small images.
    """
    height, width = last.shape
    window = np.outer(np.hanning(height), np.hanning(width))
    spectra = [np.fft.rfft2(window * (grey - grey.mean())) for grey in (last, now)]
    cross = np.conj(spectra[0]) * spectra[1]
    peaks = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-9), s=last.shape)
    v, u = np.unravel_index(int(np.argmax(peaks)), peaks.shape)
    v, u = (v + height // 2) % height - height // 2, (u + width // 2) % width - width // 2
    return se3.exp(np.array([0.0, 0.0, 0.0, -v / pinhole.fy, u / pinhole.fx, 0.0]))
