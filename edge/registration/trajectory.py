# SPDX-License-Identifier: Apache-2.0
"""The final trajectory: every tracked frame, carried by its keyframe in a pose graph."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.geometry import se3, sim3, so3
from edge.geometry.sim3 import Sim3
from edge.registration.drift_weights import Drift
from edge.registration.pose_graph import MapEdge, PoseGraph, RelativeEdge, solve
from edge.registration.turning import TurnLoss
from edge.types import F64, Fix, Mat4, OdometryUpdate

_MIN_SHARE = 1e-4  # of the scene's depth or a radian: no edge is stiffer than this
# Without depths a fix's own scale is what the filter had, known to a factor of e.
_LOOSE_LOG_SCALE = 1.0
# Variance that an odometry may be off by after it was lost for a moment, in shares of depth, rad
# and ln scale.
_GAP_VARIANCE = 0.1
# How much odometries drift, in times of the configuration, where one drive's fixes tell little of
# it, and how much more they turn from a keyframe to the next than over long ways. From 29 drives.
_USUAL_DRIFT, _TURN_BETWEEN_NEIGHBOURS = 0.4, 2.0


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    t_ns: int
    index: int
    reference_index: int | None
    T_reference_cam: Mat4 | None
    T_odom_cam: Mat4


class _Accepted(NamedTuple):
    fix: Fix
    log_scale: float  # as it was known then
    depth_m: float
    drift: Drift  # likewise


@dataclass(slots=True)
class _Drive:
    """All that belongs to one odometry frame."""

    frames: list[_Frame] = field(default_factory=list)
    keyframes: dict[int, Mat4] = field(default_factory=dict)  # T_odom_cam as known last
    # T_a_b of keyframes a and b, a having come just before b, as the last window of both had it:
    # what b is moved by later would have moved a with it, but a has left.
    steps: dict[tuple[int, int], Mat4] = field(default_factory=dict)
    accepted: dict[int, _Accepted] = field(default_factory=dict)  # by the fix's frame
    # Frames that came without a pose, known since: a keyframe, and where they are from there.
    followed: dict[int, tuple[int, Mat4]] = field(default_factory=dict)
    followed_ns: dict[int, int] = field(default_factory=dict)  # when they came
    turns: TurnLoss = field(default_factory=lambda: TurnLoss(kept=None))  # by number of `frames`
    gaps: list[int] = field(default_factory=list)  # numbers of the frames after a loss

    def is_cut(self, first: int, last: int) -> bool:
        """Whether the odometry was lost between two frames."""
        return any(min(first, last) < gap <= max(first, last) for gap in self.gaps)


class TrajectoryLog:
    """Remembers every tracked frame and accepted fix, and solves for all of them at the end."""

    def __init__(self, config: RegistrationConfig) -> None:
        self._config = config
        self._drives: dict[int, _Drive] = {}

    def add(self, update: OdometryUpdate) -> None:
        """Remember a frame and what it says of keyframes."""
        drive = self._drives.setdefault(update.odom_id, _Drive())
        if update.keyframe is not None:
            drive.turns.look(update.keyframe.depth)
            window = update.keyframe.window
            for keyframe in window:
                drive.keyframes[keyframe.index] = keyframe.T_odom_cam
            for a, b in itertools.pairwise(window):
                drive.steps[a.index, b.index] = se3.inverse(a.T_odom_cam) @ b.T_odom_cam
            for pose in update.keyframe.followed:
                T_keyframe_cam = se3.inverse(update.keyframe.T_odom_cam) @ pose.T_odom_cam
                drive.followed[pose.index] = update.keyframe.frame.index, T_keyframe_cam
                if pose.t_ns is not None:
                    drive.followed_ns[pose.index] = pose.t_ns
        if update.T_odom_cam is not None:
            drive.turns.add(len(drive.frames), update.T_odom_cam)
            drive.frames.append(
                _Frame(
                    update.t_ns,
                    update.index,
                    update.reference_index,
                    update.T_reference_cam,
                    update.T_odom_cam,
                )
            )

    def interrupt(self, odom_id: int) -> None:
        """Remember that the odometry was lost before the next frame."""
        drive = self._drives.setdefault(odom_id, _Drive())
        drive.gaps.append(len(drive.frames))

    def accept(self, odom_id: int, fix: Fix, log_scale: float, drift: Drift) -> None:
        """Remember an accepted fix, and the scale and drift that were believed then."""
        assert fix.depth_m is not None
        accepted = _Accepted(fix, log_scale, fix.depth_m, drift)
        self._drives[odom_id].accepted[fix.index] = accepted

    def solve(self) -> list[tuple[int, Mat4]]:
        """(t_ns, T_map_cam) of all frames of every odometry frame that holds an accepted fix."""
        poses: list[tuple[int, Mat4]] = []
        for drive in self._drives.values():
            if drive.accepted:
                poses += _solve_drive(drive, self._config)
        return poses


class _Held(NamedTuple):
    """A frame and the node that carries it rigidly."""

    node: int
    T_node_cam: Mat4  # [odometry units]


class _Chain(NamedTuple):
    """Nodes in the order of the drive."""

    T_odom_node: Sequence[Mat4]
    T_node_next: Sequence[Mat4]
    held: Sequence[_Held]  # one for each frame
    held_of: dict[int, _Held]  # by the index of a frame or keyframe
    way: F64  # (n, 2) path [odometry units] and turn [rad] from the first node to each
    first: Sequence[int]  # number of each node's first frame


def _solve_drive(drive: _Drive, config: RegistrationConfig) -> list[tuple[int, Mat4]]:
    chain = _chain(drive)
    accepted = [a for a in drive.accepted.values() if a.fix.index in chain.held_of]
    if not accepted:
        return []
    at = [chain.held_of[a.fix.index] for a in accepted]
    sizes = [math.log(a.depth_m) - a.log_scale for a in accepted]
    size = math.exp(float(np.median(sizes)))  # of the scene [odometry units]
    drift = Drift(*(math.sqrt(_USUAL_DRIFT * factor) for factor in accepted[-1].drift))

    relative = [
        _relative_edge(chain, n, size, drift, _lost(drive, *chain.first[n : n + 2]), config)
        for n in range(len(chain.way) - 1)
    ]
    repeats = _repeats(chain.way[[held.node for held in at]], size, config)
    to_map = [
        _map_edge(held, a, repeat, config)
        for held, a, repeat in zip(at, accepted, repeats, strict=True)
    ]
    graph = PoseGraph(relative, to_map, config.graph_cauchy_sigma)
    nodes = solve(_start(chain, at, accepted), graph, config.graph_max_steps)
    t_ns = {**drive.followed_ns, **{frame.index: frame.t_ns for frame in drive.frames}}
    # What was placed afterwards came before all else, the furthest first.
    began = drive.frames[0].index
    earlier = sorted(drive.followed_ns.keys() & chain.held_of, key=lambda k: -abs(k - began))
    tracked = {frame.index for frame in drive.frames}
    order = [
        *(index for index in earlier if index not in tracked),
        *(f.index for f in drive.frames),
    ]
    held = [chain.held_of[index] for index in order]
    return [
        (t_ns[index], sim3.transform_pose(nodes[h.node], h.T_node_cam))
        for index, h in zip(order, held, strict=True)
    ]


def _lost(drive: _Drive, first: int, last: int) -> tuple[float, float]:
    """What lies between two frames besides drift: variance of a pose's parts, and of ln scale."""
    gap = _GAP_VARIANCE if drive.is_cut(first, last) else 0.0
    return gap, gap + sum(loss.variance for loss in drive.turns.between(first, last))


def _chain(drive: _Drive) -> _Chain:
    """Give each frame to its keyframe; one whose keyframe is unknown is a node of its own."""
    numbers: dict[int, int] = {}
    first: list[int] = []
    T_odom_node: list[Mat4] = []
    held: list[_Held] = []
    for n, frame in enumerate(drive.frames):
        holder, T_holder_cam = frame.index, np.eye(4)
        reference, T_reference_cam = frame.reference_index, frame.T_reference_cam
        is_keyframe = frame.index in drive.keyframes
        if not is_keyframe and reference in drive.keyframes and T_reference_cam is not None:
            holder, T_holder_cam = reference, T_reference_cam
        if holder not in numbers:
            numbers[holder] = len(T_odom_node)
            first.append(n)
            T_odom_node.append(drive.keyframes.get(holder, frame.T_odom_cam))
        held.append(_Held(numbers[holder], T_holder_cam))
    T_node_next = [
        drive.steps.get(pair, se3.inverse(T_odom_node[n]) @ T_odom_node[n + 1])
        for n, pair in enumerate(itertools.pairwise(numbers))
    ]
    steps = [_way(T) for T in T_node_next]
    held_of = {
        index: _Held(numbers[keyframe], T_keyframe_cam)
        for index, (keyframe, T_keyframe_cam) in drive.followed.items()
        if keyframe in numbers
    }
    held_of.update({index: _Held(n, np.eye(4)) for index, n in numbers.items()})
    held_of.update({f.index: h for f, h in zip(drive.frames, held, strict=True)})
    way = np.cumsum([(0.0, 0.0), *steps], axis=0)
    return _Chain(T_odom_node, T_node_next, held, held_of, way, first)


def _way(T: Mat4) -> tuple[float, float]:
    """Path and turn of a motion."""
    return float(np.linalg.norm(T[:3, 3])), so3.angle(T[:3, :3])


def _start(chain: _Chain, at: Sequence[_Held], accepted: Sequence[_Accepted]) -> list[Sim3]:
    """Nodes as the nearest accepted fix alone would place them."""
    anchors: list[Sim3] = []
    for held, a in zip(at, accepted, strict=True):
        T_odom_cam = chain.T_odom_node[held.node] @ held.T_node_cam
        assert a.fix.T_map_cam is not None
        S_map_cam = sim3.from_se3(a.fix.T_map_cam, math.exp(a.log_scale))
        anchors.append(sim3.compose(S_map_cam, sim3.inverse(sim3.from_se3(T_odom_cam))))
    places = np.array([held.node for held in at])
    return [
        sim3.compose(anchors[int(np.argmin(np.abs(places - n)))], sim3.from_se3(T))
        for n, T in enumerate(chain.T_odom_node)
    ]


def _relative_edge(
    chain: _Chain,
    n: int,
    size: float,
    drift: Drift,
    lost: tuple[float, float],
    config: RegistrationConfig,
) -> RelativeEdge:
    """Odometry from node n to the next, with `drift` times the configured one."""
    T = chain.T_node_next[n]
    path, turn = chain.way[n + 1] - chain.way[n]
    share = max(path / size, _MIN_SHARE)
    gap, scale = lost
    position = drift.shift * config.drift_position_depth_share
    rotation = drift.bend * _TURN_BETWEEN_NEIGHBOURS * config.drift_rotation_rad
    return RelativeEdge(
        n,
        n + 1,
        T,
        size * math.sqrt(position**2 * share + gap),
        math.sqrt(rotation**2 * (share + turn) + gap),
        math.sqrt((drift.bend * config.drift_log_scale) ** 2 * share + scale),
    )


def _repeats(way: F64, size: float, config: RegistrationConfig) -> F64:
    """How many fixes (n,) share the common error of each: those near it on the way (n, 2)."""
    forgetting = np.abs(way[:, None, 0] - way[None, :, 0]) / size / config.common_path_depth_share
    forgetting += np.abs(way[:, None, 1] - way[None, :, 1]) / math.radians(config.common_turn_deg)
    return np.asarray(np.exp(-forgetting).sum(axis=1), np.float64)


def _map_edge(
    held: _Held, accepted: _Accepted, repeat: float, config: RegistrationConfig
) -> MapEdge:
    """Edge of a fix; common errors are spread over all the fixes that share them."""
    fix, log_scale, depth_m, _ = accepted
    assert fix.T_map_cam is not None
    assert fix.covariance is not None
    factor = 1.0 + config.common_share * (repeat - 1.0)
    sigma = _LOOSE_LOG_SCALE
    if fix.log_scale is not None and fix.log_scale_sigma is not None:
        # The depths were taken at the fix's pose: its error along the axis is in the scale too.
        axis = fix.T_map_cam[:3, 2]
        ahead = float(axis @ fix.covariance[:3, :3] @ axis) / depth_m**2
        log_scale, sigma = fix.log_scale, math.sqrt(factor * (fix.log_scale_sigma**2 + ahead))
    return MapEdge(
        held.node, held.T_node_cam, fix.T_map_cam, factor * fix.covariance, log_scale, sigma
    )
