# SPDX-License-Identifier: Apache-2.0
"""The pose of an image among known lines, from a pose that is nearly right."""

from typing import NamedTuple

import numpy as np

from edge.config.lines import PairingConfig
from edge.lines import pose
from edge.lines.associate import Pairs, associate
from edge.lines.line import Lines, Segments, take, take_segments
from edge.types import F64, Bools, Mat4, Pinhole

_REACH_PX = (16.0, 6.0)  # about the prediction, then about what it led to
_GATE_CHI2 = 16.0  # two freedoms: 3 in 10,000 right ones are beyond
_MIN_PAIRS = 4


class GuidedPose(NamedTuple):
    """A pose from lines and what speaks for it."""

    pose: pose.LinePose
    pairs: Pairs
    agree: Bools  # (k,) pairs within the gate


def localise(
    lines: Lines,
    span: F64,
    segments: Segments,
    camera: Pinhole,
    T_cam_lines: Mat4,
    config: PairingConfig,
) -> GuidedPose | None:
    """Pose near `T_cam_lines` (within some pixels) that the segments tell; None with too few.

    What the lines leave open stays as it was, and the covariance says so.
    """
    found = None
    for reach_px in _REACH_PX:
        pairs = associate(lines, span, segments, camera, T_cam_lines, reach_px, config)
        if len(pairs.line) < _MIN_PAIRS:
            return None
        found = pose.refine(
            take(lines, pairs.line),
            take_segments(segments, pairs.segment),
            camera,
            T_cam_lines,
        )
        T_cam_lines = found.T_cam_lines
    if found is None:
        return None
    agree = np.asarray(found.m2 < _GATE_CHI2, np.bool_)
    if np.count_nonzero(agree) < _MIN_PAIRS:
        return None
    return GuidedPose(found, pairs, agree)
