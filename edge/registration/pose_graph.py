# SPDX-License-Identifier: Apache-2.0
"""Keyframes as similarity transforms, bound to one another by odometry and to the map by fixes.

A node is (s, R, t): it takes a keyframe's camera points, in odometry units, to the map. Steps
are (7,): translation and rotation in map axes, then ln scale.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from edge.geometry import so3
from edge.geometry.sim3 import Sim3
from edge.types import F64, Mat4

I64: TypeAlias = NDArray[np.int64]

_NODE = 7
_FIRST_DAMPING = 1e-4
_MAX_DAMPING = 1e8
_ENOUGH_GAIN = 1e-7  # relative decrease of the cost below which a step is the last


class RelativeEdge(NamedTuple):
    """Odometry between two nodes: pose of node `j` in node `i`, in odometry units."""

    i: int
    j: int
    T_i_j: Mat4
    sigma_t: float  # [odometry units]
    sigma_rad: float
    sigma_log_scale: float


class MapEdge(NamedTuple):
    """A fix: the map pose of a camera that is rigidly held by a node."""

    node: int
    T_node_cam: Mat4  # [odometry units]
    T_map_cam: Mat4
    covariance: F64  # (6, 6) position and rotation in map axes
    log_scale: float
    sigma_log_scale: float


class PoseGraph(NamedTuple):
    """All edges, and how far a fix may be off before it loses its pull."""

    relative: Sequence[RelativeEdge]
    to_map: Sequence[MapEdge]
    cauchy_sigma: float


def solve(nodes: Sequence[Sim3], graph: PoseGraph, max_steps: int) -> list[Sim3]:
    """Nodes at the graph's least cost, by Levenberg-Marquardt from `nodes`."""
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import splu

    current, damping = list(nodes), _FIRST_DAMPING
    system = _linearised(current, graph)
    for _ in range(max_steps):
        H = coo_matrix(
            (system.values, (system.rows, system.columns)), shape=(_NODE * len(current),) * 2
        ).tocsc()
        while damping < _MAX_DAMPING:
            step = splu((H + diags(damping * H.diagonal())).tocsc()).solve(-system.gradient)
            trial = _linearised(_moved(current, step), graph)
            if trial.cost <= system.cost:
                break
            damping *= 10.0
        else:
            return current
        gain = system.cost - trial.cost
        current, damping, system = _moved(current, step), 0.1 * damping, trial
        if gain <= _ENOUGH_GAIN * (1.0 + trial.cost):
            break
    return current


class _System(NamedTuple):
    cost: float
    gradient: F64
    rows: I64
    columns: I64
    values: F64


class _Sum:
    """Collects the blocks of the normal equations."""

    def __init__(self, n_nodes: int) -> None:
        self.cost = 0.0
        self.gradient = np.zeros((n_nodes, _NODE))
        self._at: list[tuple[int, int]] = []
        self._blocks: list[F64] = []

    def add(self, weight: float, r: F64, *parts: tuple[int, F64]) -> None:
        """Add a whitened residual r (m,) with Jacobians (m, 7) at their nodes."""
        for a, J_a in parts:
            self.gradient[a] += weight * (J_a.T @ r)
            for b, J_b in parts:
                self._at.append((a, b))
                self._blocks.append(weight * (J_a.T @ J_b))

    def system(self) -> _System:
        values = np.array(self._blocks)
        at, inner = _NODE * np.array(self._at, np.int64), np.arange(_NODE)
        rows = np.broadcast_to(at[:, 0, None, None] + inner[:, None], values.shape)
        columns = np.broadcast_to(at[:, 1, None, None] + inner, values.shape)
        return _System(
            self.cost, self.gradient.ravel(), rows.ravel(), columns.ravel(), values.ravel()
        )


def _linearised(nodes: Sequence[Sim3], graph: PoseGraph) -> _System:
    total = _Sum(len(nodes))
    for edge in graph.relative:
        r, J_i, J_j = relative_residual(nodes[edge.i], nodes[edge.j], edge)
        total.cost += float(r @ r)
        total.add(1.0, r, (edge.i, J_i), (edge.j, J_j))
    limit = graph.cauchy_sigma**2 * 6.0
    for fix in graph.to_map:
        r, J = map_residual(nodes[fix.node], fix)
        chi2 = float(r @ r)
        total.cost += limit * math.log1p(chi2 / limit)
        total.add(1.0 / (1.0 + chi2 / limit), r, (fix.node, J))
    return total.system()


def relative_residual(a: Sim3, b: Sim3, edge: RelativeEdge) -> tuple[F64, F64, F64]:
    """Whitened residual (7,) and its Jacobians (7, 7) by the two nodes' steps."""
    R_m, t_m = edge.T_i_j[:3, :3], edge.T_i_j[:3, 3]
    between = (b.t - a.t) / a.s
    turned = R_m.T @ a.R.T
    w = so3.log(turned @ b.R)
    r = np.concatenate((a.R.T @ between - t_m, w, [math.log(b.s / a.s)]))
    J_a, J_b = np.zeros((_NODE, _NODE)), np.zeros((_NODE, _NODE))
    J_b[:3, :3] = a.R.T / a.s
    J_b[3:6, 3:6] = so3.left_jacobian_inverse(w) @ turned
    J_b[6, 6] = 1.0
    J_a[:] = -J_b
    J_a[:3, 3:6] = a.R.T @ so3.hat(between)
    J_a[:3, 6] = -(a.R.T @ between)
    weight = 1.0 / np.repeat((edge.sigma_t, edge.sigma_rad, edge.sigma_log_scale), (3, 3, 1))
    return weight * r, weight[:, None] * J_a, weight[:, None] * J_b


def map_residual(node: Sim3, edge: MapEdge) -> tuple[F64, F64]:
    """Whitened residual (7,) and its Jacobian (7, 7) by the node's step."""
    lever = node.s * (node.R @ edge.T_node_cam[:3, 3])
    R = node.R @ edge.T_node_cam[:3, :3]
    w = so3.log(edge.T_map_cam[:3, :3] @ R.T)
    r = np.concatenate(
        (edge.T_map_cam[:3, 3] - lever - node.t, w, [edge.log_scale - math.log(node.s)])
    )
    J = np.zeros((_NODE, _NODE))
    J[:3, :3] = -np.eye(3)
    J[:3, 3:6] = so3.hat(lever)
    J[:3, 6] = -lever
    J[3:6, 3:6] = -so3.left_jacobian_inverse(-w)
    J[6, 6] = -1.0
    whiten = np.zeros((_NODE, _NODE))
    whiten[:6, :6] = np.linalg.inv(np.linalg.cholesky(edge.covariance))
    whiten[6, 6] = 1.0 / edge.sigma_log_scale
    return whiten @ r, whiten @ J


def _moved(nodes: Sequence[Sim3], step: F64) -> list[Sim3]:
    moved = []
    for node, d in zip(nodes, step.reshape(-1, _NODE), strict=True):
        R = so3.normalise(so3.exp(d[3:6]) @ node.R)
        moved.append(Sim3(node.s * math.exp(d[6]), R, node.t + d[:3]))
    return moved
