# SPDX-License-Identifier: Apache-2.0
"""Whether several fixes tell of one and the same place, so that together they may be believed."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.registration import anchor as filters
from edge.registration.anchor import Anchor
from edge.registration.gates import chi2_quantile
from edge.registration.motion import OdometryTrack
from edge.types import Fix


def agreeing(
    fixes: Sequence[Fix], track: OdometryTrack, needed: int, config: RegistrationConfig
) -> tuple[Anchor, tuple[Fix, ...]] | None:
    """Anchor from the largest set of at least `needed` agreeing fixes that holds the newest.

    `fixes` are ordered by frame, and all their frames are in `track`. Besides agreeing, two of
    the set must be independent: seen over a baseline, or on different map keyframes.
    """
    *earlier, newest = fixes
    for size in range(len(earlier), needed - 2, -1):
        for chosen in itertools.combinations(earlier, size):
            group = (*chosen, newest)
            # Two fixes without depths fit any odometry: its scale is what makes them fit.
            if size + 1 < 3 and all(fix.log_scale is None for fix in group):
                continue
            anchor = _joined(group, track, config)
            if anchor is not None and _independent(group, config):
                return anchor, group
    return None


def extended(
    anchor: Anchor, fixes: Sequence[Fix], track: OdometryTrack, config: RegistrationConfig
) -> Anchor | None:
    """Anchor filtered over `fixes`, which come after it; None where one does not fit."""
    pose_gate = chi2_quantile(config.gate_probability, 6)
    scale_gate = chi2_quantile(config.gate_probability, 1)
    for fix in fixes:
        motion = track.between(anchor.index, fix.index)
        anchor = filters.predict(anchor, motion, fix.index, config)
        innovation = filters.compare(anchor, fix, config)
        if innovation.chi2_pose > pose_gate or innovation.chi2_scale > scale_gate:
            return None
        use_scale = filters.needs_depths(anchor, config)
        anchor = filters.update(anchor, fix, innovation, use_scale=use_scale)
    return anchor


def _joined(
    fixes: Sequence[Fix], track: OdometryTrack, config: RegistrationConfig
) -> Anchor | None:
    """Anchor started at the first of `fixes` and filtered over the others."""
    log_scale = _log_scale(fixes, track)
    if log_scale is None:
        return None
    return extended(filters.start(fixes[0], log_scale, config), fixes[1:], track, config)


def _log_scale(fixes: Sequence[Fix], track: OdometryTrack) -> float | None:
    """Where to linearise the scale: from depths, else from the baselines; None if neither can.

    The filter itself weighs both; this is only its starting point.
    """
    told = [
        (f.log_scale, 1.0 / f.log_scale_sigma**2)
        for f in fixes
        if f.log_scale is not None and f.log_scale_sigma is not None
    ]
    if told:
        values, weights = np.array(told).T
        return float(np.average(values, weights=weights))
    map_by_odom = odom_by_odom = 0.0
    first = fixes[0]
    assert first.T_map_cam is not None
    for fix in fixes[1:]:
        assert fix.T_map_cam is not None
        in_odom = first.T_map_cam[:3, :3] @ track.between(first.index, fix.index).T_from_to[:3, 3]
        in_map = fix.T_map_cam[:3, 3] - first.T_map_cam[:3, 3]
        map_by_odom += float(in_map @ in_odom)
        odom_by_odom += float(in_odom @ in_odom)
    if map_by_odom <= 0.0 or odom_by_odom <= 0.0:
        return None
    return math.log(map_by_odom / odom_by_odom)


def _independent(fixes: Sequence[Fix], config: RegistrationConfig) -> bool:
    """Whether some two of `fixes` are more than one vote."""
    return any(independent(a, b, config) for a, b in itertools.combinations(fixes, 2))


def independent(a: Fix, b: Fix, config: RegistrationConfig) -> bool:
    """Whether two fixes are two votes."""
    assert a.T_map_cam is not None
    assert b.T_map_cam is not None
    assert a.depth_m is not None
    assert b.depth_m is not None
    baseline = float(np.linalg.norm(a.T_map_cam[:3, 3] - b.T_map_cam[:3, 3]))
    if baseline >= config.vote_baseline_depth_share * min(a.depth_m, b.depth_m):
        return True
    common = len(set(a.support) & set(b.support))
    return common <= config.vote_support_overlap * min(len(set(a.support)), len(set(b.support)))
