# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from edge.geometry import se3, sim3, so3
from edge.geometry.sim3 import Sim3
from edge.registration.pose_graph import (
    MapEdge,
    PoseGraph,
    RelativeEdge,
    map_residual,
    relative_residual,
    solve,
)

AXES = ["tx", "ty", "tz", "rx", "ry", "rz", "log s"]


def loop(n: int = 24) -> list[Sim3]:
    """Nodes on a circle of 2 m that look inward; their scale drifts by 10 % over the loop."""
    nodes = []
    for k in range(n):
        a = 2.0 * math.pi * k / n
        T = se3.exp([0, 0, 0, 0, a, 0]) @ se3.exp([0, 0.1 * math.sin(3 * a), -2.0, 0, 0, 0])
        nodes.append(Sim3(0.5 * math.exp(0.1 * k / n), T[:3, :3], T[:3, 3]))
    return nodes


def edge_between(nodes: list[Sim3], i: int, j: int) -> RelativeEdge:
    S = sim3.compose(sim3.inverse(nodes[i]), nodes[j])
    return RelativeEdge(i, j, se3.from_rotation_translation(S.R, S.t), 0.01, 0.005, 0.02)


def edge_to_map(nodes: list[Sim3], n: int, T_off: np.ndarray | None = None) -> MapEdge:
    T_node_cam = se3.exp([0.05, -0.1, 0.2, 0.1, 0.0, -0.2])
    T_map_cam = sim3.transform_pose(nodes[n], T_node_cam)
    if T_off is not None:
        T_map_cam = T_off @ T_map_cam
    covariance = np.diag(np.repeat((0.005**2, 0.003**2), 3))
    return MapEdge(n, T_node_cam, T_map_cam, covariance, math.log(nodes[n].s), 0.02)


def disturbed(nodes: list[Sim3], size: float, seed: int) -> list[Sim3]:
    rng = np.random.default_rng(seed)
    return [sim3.compose(sim3.exp(size * rng.normal(size=7)), node) for node in nodes]


def furthest(nodes: list[Sim3], truth: list[Sim3]) -> float:
    return max(float(np.linalg.norm(a.t - b.t)) for a, b in zip(nodes, truth, strict=True))


def step(node: Sim3, d: np.ndarray) -> Sim3:
    return Sim3(node.s * math.exp(d[6]), so3.exp(d[3:6]) @ node.R, node.t + d[:3])


@pytest.mark.parametrize("axis", range(7), ids=AXES)
def test_relative_jacobians_are_those_of_the_residual(axis: int) -> None:
    nodes = disturbed(loop()[:2], 0.2, 1)
    edge = edge_between(loop(), 0, 1)
    _, J_i, J_j = relative_residual(*nodes, edge)
    d = np.zeros(7)
    d[axis] = 1e-6
    i = relative_residual(step(nodes[0], d), nodes[1], edge)[0]
    i -= relative_residual(step(nodes[0], -d), nodes[1], edge)[0]
    j = relative_residual(nodes[0], step(nodes[1], d), edge)[0]
    j -= relative_residual(nodes[0], step(nodes[1], -d), edge)[0]
    np.testing.assert_allclose(i / 2e-6, J_i[:, axis], atol=1e-4)
    np.testing.assert_allclose(j / 2e-6, J_j[:, axis], atol=1e-4)


@pytest.mark.parametrize("axis", range(7), ids=AXES)
def test_map_jacobian_is_that_of_the_residual(axis: int) -> None:
    node = disturbed(loop()[:1], 0.2, 2)[0]
    edge = edge_to_map(loop(), 0)
    _, J = map_residual(node, edge)
    d = np.zeros(7)
    d[axis] = 1e-6
    slope = (map_residual(step(node, d), edge)[0] - map_residual(step(node, -d), edge)[0]) / 2e-6
    np.testing.assert_allclose(slope, J[:, axis], atol=1e-4)


def test_loop_with_exact_edges_equals_truth() -> None:
    truth = [Sim3(0.5, node.R, node.t) for node in loop()]
    relative = [edge_between(truth, k, (k + 1) % len(truth)) for k in range(len(truth))]
    to_map = [edge_to_map(truth, k) for k in (0, 8, 16)]
    solved = solve(disturbed(truth, 0.1, 0), PoseGraph(relative, to_map, 2.0), 50)
    assert furthest(solved, truth) < 1e-6


def test_fixes_take_out_the_drift_of_the_scale() -> None:
    truth = loop()
    relative = [edge_between(truth, k, k + 1) for k in range(len(truth) - 1)]
    to_map = [edge_to_map(truth, k) for k in (0, 4, 8, 12, 16, 20, 23)]
    solved = solve(disturbed(truth, 0.1, 0), PoseGraph(relative, to_map, 2.0), 50)
    assert furthest(solved, truth) < 0.005
    assert solved[20].s == pytest.approx(truth[20].s, rel=0.02)


def test_odometry_alone_carries_nodes_far_from_the_only_fixes() -> None:
    truth = [Sim3(0.5, node.R, node.t) for node in loop()]
    relative = [edge_between(truth, k, k + 1) for k in range(len(truth) - 1)]
    to_map = [edge_to_map(truth, k) for k in (3, 6)]
    solved = solve(disturbed(truth, 0.1, 1), PoseGraph(relative, to_map, 2.0), 50)
    assert furthest(solved, truth) < 1e-6


def test_a_wrong_fix_loses_its_pull() -> None:
    truth = [Sim3(0.5, node.R, node.t) for node in loop()]
    relative = [edge_between(truth, k, k + 1) for k in range(len(truth) - 1)]
    to_map = [edge_to_map(truth, k) for k in range(0, 24, 3)]
    to_map.append(edge_to_map(truth, 10, se3.exp([0.6, 0.2, 0.0, 0.0, 0.3, 0.0])))
    solved = solve(disturbed(truth, 0.02, 2), PoseGraph(relative, to_map, 2.0), 50)
    assert furthest(solved, truth) < 0.01
