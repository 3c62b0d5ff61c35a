# SPDX-License-Identifier: Apache-2.0
"""How the camera moves through a room."""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from edge.types import F64
from tools.simworld.errors import WorldError
from tools.simworld.tremor import Tremor
from tools.simworld.world import World

I64: TypeAlias = NDArray[np.int64]

KINDS = ("walk", "forward", "rotation", "held", "still", "robot")
CLEARANCE_M = 0.25
KNOT_S = 1.6  # between control points: the body's own motion lies below about 0.4 Hz
LAP_S = 26.0  # once around the room
ROBOT_KNOT_S = 0.2
ROBOT_STEP_M, ROBOT_STEP_RAD = 0.6 * ROBOT_KNOT_S, math.radians(50.0) * ROBOT_KNOT_S
TRIES = 200
MARGIN_S = 0.5  # the path goes on before its first and after its last frame
BACKLASH_M = 1.1  # furniture along the walls


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A camera's motion, known at every moment."""

    spline: BSpline  # of x, y, z [m], yaw, pitch, roll [rad] over time [s]
    tremor: Tremor | None
    t_ns: I64  # (n,) mid-exposure of each frame

    @property
    def T_world_cam(self) -> F64:  # the field's name
        """Pose of each frame (n, 4, 4)."""
        return self.at(seconds_of(self.t_ns))

    def at(self, times_s: F64) -> F64:
        """Poses T_world_cam (n, 4, 4) at times (n,) [s]."""
        values = self.spline(times_s)
        R = _level_camera(values[:, 3], values[:, 4], values[:, 5])
        t = values[:, :3]
        if self.tremor is not None:
            shift, turn = self.tremor.at(times_s)
            t = t + np.einsum("nij,nj->ni", R, shift)
            R = R @ Rotation.from_rotvec(turn).as_matrix()
        T = np.broadcast_to(np.eye(4), (len(times_s), 4, 4)).copy()
        T[:, :3, :3], T[:, :3, 3] = R, t
        return T


def seconds_of(t_ns: I64) -> F64:
    """Times in seconds."""
    return np.asarray(t_ns * 1e-9, np.float64)


def _level_camera(yaw: F64, pitch: F64, roll: F64) -> F64:
    """R_world_cam (n, 3, 3) of cameras looking along yaw and pitch (up positive), then rolled."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    zero = np.zeros_like(yaw)
    right = np.stack([sy, -cy, zero], axis=-1)
    down = np.stack([cy * sp, sy * sp, -cp], axis=-1)
    ahead = np.stack([cy * cp, sy * cp, sp], axis=-1)
    R = np.stack([right, down, ahead], axis=-1)
    return np.asarray(
        R @ Rotation.from_rotvec(roll[:, None] * np.array([0.0, 0.0, 1.0])).as_matrix(), np.float64
    )


def make_path(
    world: World,
    seed: int,
    seconds: float,
    rate_hz: float = 20.0,
    kind: str = "walk",
    tremor: float = 1.0,
) -> Path:
    """A collision-free path of `seconds` at `rate_hz`; the same seed gives the same path.

    `kind`: `walk` goes around the room and looks across it, `forward` along its
    longer side, `rotation` turns on the spot without any shift, `held` has the
    hand's tremor alone, `still` nothing at all; `robot` drives straight, stops, turns
    on the spot and drives on. `tremor` scales the hand's part, or a robot's shaking.
    """
    if kind not in KINDS:
        raise WorldError(f"path kind {kind!r} is unknown; take one of {', '.join(KINDS)}")
    if not (seconds > 0.0 and rate_hz > 0.0):
        raise WorldError(f"a path of {seconds} s at {rate_hz} Hz has no frames; ask for more")
    count = max(1, round(seconds * rate_hz))
    t_ns = np.rint(np.arange(count) * 1e9 / rate_hz).astype(np.int64)
    rng = np.random.default_rng([seed, KINDS.index(kind), 99])
    for attempt in range(TRIES):
        points = _CONTROL[kind](world, rng, seconds, attempt / TRIES)
        strength = tremor * (0.15 if kind == "robot" else 1.0)
        hand = None if kind == "still" else Tremor(rng, strength, shifts=kind != "rotation")
        path = Path(_spline(points, seconds), hand, t_ns)
        every = np.arange(0.0, seconds, 0.05)
        if world.clearance(path.at(every)[:, :3, 3]).min() > CLEARANCE_M:
            return path
    raise WorldError(f"no free path of kind {kind!r} in this room; try another seed")


def _spline(points: F64, seconds: float) -> BSpline:
    """Uniform cubic B-spline over control points (k, 6); covers [-MARGIN_S, seconds + MARGIN_S]."""
    k = len(points)
    start, end = -MARGIN_S, seconds + MARGIN_S
    step = (end - start) / (k - 3)
    knots = start + step * (np.arange(k + 4) - 3)
    return BSpline(knots, points, 3)


def _moments(seconds: float) -> F64:
    """Times of the control points [s]."""
    k = max(math.ceil((seconds + 2 * MARGIN_S) / KNOT_S), 1) + 3
    return np.linspace(-MARGIN_S - KNOT_S, seconds + MARGIN_S + KNOT_S, k)


def _wander(rng: np.random.Generator, n: int, low: float, high: float) -> F64:
    """Control values (n,), each between the bounds, loosely following one another."""
    steps = rng.normal(0.0, 0.6, n).cumsum() + rng.uniform(0.0, 2.0 * math.pi)
    return low + (high - low) * (0.5 + 0.5 * np.sin(steps))


def _walk(world: World, rng: np.random.Generator, seconds: float, ease: float) -> F64:
    times = _moments(seconds)
    n = len(times)
    # all drives of a room begin at about the same place, so that short ones overlap too
    room = np.random.default_rng([world.seed, 3])
    start, way = room.uniform(0.0, 2.0 * math.pi), room.choice([-1.0, 1.0])
    angle = start + rng.normal(0.0, 0.35) + way * 2.0 * math.pi * times / LAP_S
    half = np.maximum(0.5 * np.array(world.size_m[:2]) - BACKLASH_M, 0.2)
    # the longer no way is found, the closer to the middle
    radius = _wander(rng, n, 0.55 * (1.0 - ease), 1.0 - 0.7 * ease)
    x, y = half[0] * radius * np.cos(angle), half[1] * radius * np.sin(angle)
    z = _wander(rng, n, 1.25, 1.65)
    yaw = angle + math.pi + _wander(rng, n, -0.6, 0.6)
    pitch = _wander(rng, n, -0.36, -0.08)
    return np.stack([x, y, z, yaw, pitch, _wander(rng, n, -0.08, 0.08)], axis=1)


def _forward(world: World, rng: np.random.Generator, seconds: float, ease: float) -> F64:
    times = _moments(seconds)
    n = len(times)
    axis = int(world.size_m[1] > world.size_m[0])
    reach = 0.5 * world.size_m[axis] - 1.6
    speed = min(rng.uniform(1.0, 1.4), 2.0 * reach / (seconds + 2.0 * KNOT_S))
    along = -reach + speed * (times - times[0])
    aside = _wander(rng, n, -0.25, 0.25)
    xy = (along, aside) if axis == 0 else (aside, along)
    yaw = 0.5 * math.pi * axis + _wander(rng, n, -0.12, 0.12)
    pitch, roll = _wander(rng, n, -0.1, 0.0), _wander(rng, n, -0.03, 0.03)
    return np.stack([*xy, _wander(rng, n, 1.45, 1.6), yaw, pitch, roll], axis=1)


def _spot(world: World, rng: np.random.Generator) -> F64:
    half = np.maximum(0.5 * np.array(world.size_m[:2]) - BACKLASH_M, 0.2)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    xy = half * rng.uniform(0.3, 1.0) * (math.cos(angle), math.sin(angle))
    yaw = angle + math.pi + rng.uniform(-0.5, 0.5)
    return np.array([*xy, rng.uniform(1.25, 1.6), yaw, rng.uniform(-0.3, -0.1), 0.0])


def _rotation(world: World, rng: np.random.Generator, seconds: float, ease: float) -> F64:
    times = _moments(seconds)
    points = np.repeat(_spot(world, rng)[None], len(times), axis=0)
    points[:, 3] += math.radians(20.0) * times
    points[:, 4] += _wander(rng, len(times), -0.15, 0.15)
    return points


def _fixed(world: World, rng: np.random.Generator, seconds: float, ease: float) -> F64:
    return np.repeat(_spot(world, rng)[None], len(_moments(seconds)), axis=0)


def _robot(world: World, rng: np.random.Generator, seconds: float, ease: float) -> F64:
    n = math.ceil((seconds + 2 * MARGIN_S) / ROBOT_KNOT_S) + 5
    half = np.maximum(0.5 * np.array(world.size_m[:2]) - BACKLASH_M, 0.2) * (1.0 - 0.6 * ease)
    xy, yaw = rng.uniform(-half, half), rng.uniform(0.0, 2.0 * math.pi)
    legs: list[F64] = []
    while sum(len(leg) for leg in legs) < n:
        goal = rng.uniform(-half, half)
        way = float(np.linalg.norm(goal - xy))
        turn = _turn(yaw, math.atan2(*(goal - xy)[::-1]))
        pause = int(rng.integers(2, 6))
        yaws = yaw + turn * _ramp(abs(turn) / ROBOT_STEP_RAD)
        places = xy + (goal - xy) * _ramp(way / ROBOT_STEP_M)[:, None]
        yaw = float(yaws[-1])
        legs += [np.column_stack([np.tile(xy, (len(yaws), 1)), yaws])]
        legs += [np.column_stack([places, np.full(len(places), yaw)])]
        legs += [np.tile([*goal, yaw], (pause, 1))]
        xy = goal
    x, y, yaws = np.concatenate(legs)[:n].T
    rest = np.tile([rng.uniform(0.9, 1.3), rng.uniform(-0.12, 0.0), 0.0], (n, 1))
    return np.column_stack([x, y, rest[:, 0], yaws, rest[:, 1:]])


def _turn(yaw: float, goal: float) -> float:
    """The shorter way around, in -pi to pi."""
    return math.remainder(goal - yaw, 2.0 * math.pi)


def _ramp(steps: float) -> F64:
    """From 0 to 1 in about so many steps of full speed, speeding up and slowing down."""
    n = max(2, math.ceil(1.5 * steps))
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * (np.arange(n) + 1) / n), np.float64)


_CONTROL = {
    "walk": _walk, "forward": _forward, "rotation": _rotation, "held": _fixed, "still": _fixed,
    "robot": _robot,
}  # fmt: skip
