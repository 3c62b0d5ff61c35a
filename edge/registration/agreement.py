# SPDX-License-Identifier: Apache-2.0
"""Whether several fixes tell of one and the same place, so that together they may be believed."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.geometry import se3
from edge.registration.constellation import Constellation
from edge.registration.gates import chi2_quantile
from edge.registration.motion import OdometryTrack
from edge.registration.noise import pose_difference
from edge.types import F64, Fix, MapStart

Agreed: TypeAlias = tuple[Constellation, tuple[Fix, ...]]


def agreeing(
    fixes: Sequence[Fix], track: OdometryTrack, needed: int, config: RegistrationConfig
) -> Agreed | None:
    """The largest set of at least `needed` agreeing fixes that holds the newest.

    `fixes` are ordered by frame, and all their frames are in `track`. Besides agreeing, two of
    the set must be independent: seen over a baseline, or on different map keyframes; unless one
    fix alone is needed.
    """
    *earlier, newest = fixes
    for size in range(len(earlier), needed - 2, -1):
        for chosen in itertools.combinations(earlier, size):
            group = (*chosen, newest)
            # Two fixes without depths fit any odometry: its scale is what makes them fit.
            if size + 1 < 3 and all(fix.log_scale is None for fix in group):
                continue
            joined = _joined(group, track, config)
            if joined is not None and (needed == 1 or _independent(group, config)):
                return _freed(group, track, config) or (joined, group)
    return None


def _freed(
    fixes: tuple[Fix, ...], track: OdometryTrack, config: RegistrationConfig
) -> Agreed | None:
    """The same without the scale of the odometry's start, where the newest tells another.

    Depths that are all too small by one factor agree with one another, and the odometry that
    starts from them is wrong by it: only the way from fix to fix can tell.
    """
    first, newest = fixes[0], fixes[-1]
    if first.index != track.founder or first.log_scale is None or len(fixes) < 2:
        return None
    free = (replace(first, log_scale=None, log_scale_sigma=None), *fixes[1:])
    seeded, unseeded = (_joined(some[:-1], track, config) for some in (fixes, free))
    joined = _joined(free, track, config)
    if seeded is None or unseeded is None or joined is None:
        return None
    told = seeded.compare(newest).chi2_pose - unseeded.compare(newest).chi2_pose
    if told <= chi2_quantile(config.seed_gate_probability, 1):
        return None
    return joined, free


def standing(
    fixes: Sequence[Fix], track: OdometryTrack, config: RegistrationConfig
) -> Agreed | None:
    """Fixes that agree by the odometry as closely as those of a camera at rest: all, or the last.

    Seen from nearly one place they are nearly one vote: so it asks for as many, over as long a
    time, as `Rest` does, and for as small a spread.
    """
    last = long_enough(fixes, config.rest_fixes, config)
    if not last or (of_last := _standing(last, track, config)) is None:
        return None  # then all hardly ever do, and many cost much
    return _standing(tuple(fixes), track, config) or of_last


def _standing(
    fixes: tuple[Fix, ...], track: OdometryTrack, config: RegistrationConfig
) -> Agreed | None:
    joined = _joined(fixes, track, config)
    if joined is None or not _is_close(fixes, joined, track, config):
        return None
    return joined, fixes


def _is_close(
    fixes: Sequence[Fix], joined: Constellation, track: OdometryTrack, config: RegistrationConfig
) -> bool:
    for fix in fixes:
        assert fix.T_map_cam is not None
        assert fix.depth_m is not None
        off = pose_difference(fix.T_map_cam, joined.locate(track.frame(fix.index)).T_map_cam)
        if np.linalg.norm(off[:3]) > config.rest_depth_share * fix.depth_m:
            return False
        if np.linalg.norm(off[3:]) > config.rest_depth_share:
            return False
    return True


def agree(fixes: Sequence[Fix], track: OdometryTrack, config: RegistrationConfig) -> bool:
    """Whether `fixes`, ordered by frame, agree with one another."""
    return _joined(fixes, track, config) is not None


def long_enough(fixes: Sequence[Fix], least: int, config: RegistrationConfig) -> tuple[Fix, ...]:
    """The fewest last ones of `fixes` that are `least` and span the time of a rest, or none."""
    for n in range(least, len(fixes) + 1):
        if abs(fixes[-1].t_ns - fixes[-n].t_ns) * 1e-9 >= config.rest_span_s:
            return tuple(fixes[-n:])
    return ()


def founding(earlier: Sequence[Fix], newest: Fix, config: RegistrationConfig) -> Fix | None:
    """The last of `earlier` with depths that is another vote than `newest`, a possible way off.

    There is no odometry yet between them; one that starts from those depths tells whether they
    agree.
    """
    for fix in reversed(earlier):
        if (
            fix.depth is not None
            and independent(fix, newest, config)
            and _reachable(fix, newest, config)
        ):
            return fix
    return None


def start_at(
    first: Fix, earlier: Sequence[Fix], newest: Fix, config: RegistrationConfig
) -> MapStart | None:
    """What an odometry may start from at `first`, moving as `newest` and those before it tell."""
    if first.depth is None:
        return None
    return MapStart(first.index, first.depth, _velocity(earlier, newest, config))


def _velocity(earlier: Sequence[Fix], newest: Fix, config: RegistrationConfig) -> F64:
    """How the camera moves by the last of `earlier` from which it can have come to `newest`.

    (6,) in its own axes [m/s, rad/s]; 0 where there is none.
    """
    for fix in reversed(earlier):
        if fix.t_ns != newest.t_ns and _reachable(fix, newest, config):
            assert fix.T_map_cam is not None
            assert newest.T_map_cam is not None
            way = se3.log(se3.inverse(fix.T_map_cam) @ newest.T_map_cam)
            return np.asarray(way / ((newest.t_ns - fix.t_ns) * 1e-9))
    return np.zeros(6)


def _reachable(a: Fix, b: Fix, config: RegistrationConfig) -> bool:
    """Whether a camera can come from one to the other in the time between them."""
    assert a.T_map_cam is not None
    assert b.T_map_cam is not None
    assert a.depth_m is not None
    assert b.depth_m is not None
    span_s = abs(a.t_ns - b.t_ns) * 1e-9
    off = pose_difference(a.T_map_cam, b.T_map_cam)
    reach_m = config.fastest_depths_per_s * span_s * min(a.depth_m, b.depth_m)
    turned = float(np.linalg.norm(off[3:]))
    return float(np.linalg.norm(off[:3])) <= reach_m and turned <= config.fastest_rad_per_s * span_s


def _joined(
    fixes: Sequence[Fix], track: OdometryTrack, config: RegistrationConfig
) -> Constellation | None:
    """The first of `fixes`, joined by the others."""
    log_scale = _log_scale(fixes, track)
    if log_scale is None:
        return None
    return Constellation(track, log_scale, config, fixes[:1]).joined(fixes[1:])


def _log_scale(fixes: Sequence[Fix], track: OdometryTrack) -> float | None:
    """Where to linearise the scale: from depths, else from the baselines; None if neither can.

    The constellation itself weighs both; this is only its starting point.
    """
    told = [
        (f.log_scale, 1.0 / f.log_scale_sigma**2)
        for f in fixes
        if f.log_scale is not None and f.log_scale_sigma is not None
    ]
    if told:
        values, weights = np.array(told).T
        return float(np.average(values, weights=weights))
    if track.founder is not None:
        return 0.0
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
