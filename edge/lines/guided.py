# SPDX-License-Identifier: Apache-2.0
"""The pose of an image among known lines, from a pose that is nearly right."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from edge.config.lines import PairingConfig
from edge.lines import pose
from edge.lines.associate import Pairs, associate
from edge.lines.line import Lines, Segments, take, take_segments
from edge.types import F64, Bools, Mat4, Pinhole

# Near ones first: among parallel neighbours the nearest is right where the prediction is good.
_REACH_PX = (6.0, 16.0)
_ENOUGH_SHARE = 0.6  # of the lines expected, that agree: no wider reach is tried
# Where most pairs contradict the pose, it is that of a wrong pairing.
_MIN_SHARE = 0.6
_GATE_CHI2 = 16.0  # two freedoms: 3 in 10,000 right ones are beyond
_MIN_PAIRS = 4
# Some lines pair with something at any pose, and six freedoms make four pairs agree.
_MIN_AGREEING = 8
_MIN_EXPECTED_SHARE = 0.25  # of the lines that should be seen; clutter hides many


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
    """Pose near `T_cam_lines` (within some pixels) that the segments tell, if most agree.

    What the lines leave open stays as it was, and the covariance says so.
    """
    pair = partial(associate, lines, span, segments, camera, config=config)
    best = None
    for reach_px in _REACH_PX:
        found = _from(pair, lines, segments, camera, T_cam_lines, reach_px)
        if found is not None and (best is None or found.agree.sum() > best.agree.sum()):
            best = found
        if best is not None and best.agree.sum() >= _ENOUGH_SHARE * len(best.pairs.expected):
            break
    if best is None:
        return None
    enough = max(
        _MIN_AGREEING,
        _MIN_SHARE * len(best.agree),
        _MIN_EXPECTED_SHARE * len(best.pairs.expected),
    )
    return best if best.agree.sum() >= enough else None


def _from(
    pair: Callable[[Mat4, float], Pairs],
    lines: Lines,
    segments: Segments,
    camera: Pinhole,
    T_cam_lines: Mat4,
    reach_px: float,
) -> GuidedPose | None:
    """Pose to which pairs within a reach lead, and then those near to it."""
    best = None
    for reach in (reach_px, min(_REACH_PX)):
        pairs = pair(T_cam_lines, reach)
        if len(pairs.line) < _MIN_PAIRS:
            return None
        known, seen = take(lines, pairs.line), take_segments(segments, pairs.segment)
        found = pose.refine(known, seen, camera, T_cam_lines)
        T_cam_lines = found.T_cam_lines
        best = GuidedPose(found, pairs, np.asarray(found.m2 < _GATE_CHI2, np.bool_))
    return best
