# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.odometry import kernels_line_start as kl
from edge.odometry.line_structure import Seen, reconstruct
from edge.types import F64, Mat4
from tests.edge.odometry import numeric

FOCAL_PX = 260.0
NORMALISED = np.array([1.0, 1.0, 0.0, 0.0], np.float32)
# The last motion, and how a hand sways meanwhile: edges say nothing of a straight and even one.
MOTIONS = {
    "sideways": [0.12, 0.0, 0.0, 0.0, 0.02, 0.0],
    "sideways and turning": [0.1, 0.03, 0.02, 0.01, -0.05, 0.02],
}
SWAY = 0.02


def poses(motion: list[float]) -> list[Mat4]:
    rng = np.random.default_rng(3)
    shares = (0.2, 0.4, 0.6, 0.8, 1.0)
    return [se3.exp(np.array(motion) * s + SWAY * rng.normal(size=6)) for s in shares]


def scene(
    rng: np.random.Generator, corners: int, edges: int, T: list[Mat4], noise_px: float
) -> tuple[Seen, F64]:
    """What is seen of corners and edges in space, and all inverse depths."""
    corner = rng.uniform((-0.6, -0.45), (0.6, 0.45), (corners, 2))
    end = rng.uniform((-0.6, -0.45), (0.6, 0.45), (2 * edges, 2))
    idepth = 1.0 / rng.uniform(1.0, 4.0, corners + 2 * edges)
    sigma = noise_px / FOCAL_PX
    corner_at = np.stack([_seen_from(pose, corner, idepth[:corners]) for pose in T])
    corner_at += rng.normal(0.0, sigma, corner_at.shape)
    end_at = np.stack([_seen_from(pose, end, idepth[corners:]) for pose in T])
    end_at += rng.normal(0.0, sigma, end_at.shape)
    along = end_at[:, 1::2] - end_at[:, ::2]
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    normal = np.stack((-along[..., 1], along[..., 0]), axis=2)
    offset = -np.sum(normal * end_at[:, ::2], axis=2)
    line = np.repeat(np.dstack((normal, offset)), 2, axis=1)
    seen = Seen(
        corner,
        corner_at,
        np.ones(corner_at.shape[:2], np.uint8),
        end,
        line,
        np.ones(line.shape[:2], np.uint8),
    )
    return seen, idepth


def _seen_from(T: Mat4, rays: F64, idepth: F64) -> F64:
    return numeric.project(T, rays[:, 0], rays[:, 1], idepth, NORMALISED)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_few_exact_corners_and_edges_give_exact_depths_and_poses(motion: list[float]) -> None:
    T = poses(motion)
    seen, idepth = scene(np.random.default_rng(1), 10, 14, T, 0.0)
    found = reconstruct(seen, FOCAL_PX)
    assert found is not None
    structure = found.structure
    assert structure.inlier.all()
    assert found.fit_px < 0.01
    assert found.rival_px > 0.05
    scale = float(np.median(idepth))
    np.testing.assert_allclose(structure.inverse_depth * scale, idepth, rtol=1e-2)
    last = structure.T_frame_reference[-1]
    np.testing.assert_allclose(last[:3, :3], T[-1][:3, :3], atol=1e-3)
    np.testing.assert_allclose(last[:3, 3] / scale, T[-1][:3, 3], atol=1e-3)


def test_corners_that_are_none_are_left_out() -> None:
    T = poses(MOTIONS["sideways"])
    seen, idepth = scene(np.random.default_rng(2), 12, 14, T, 0.05)
    # Where one edge passes behind another there is a corner that slides.
    seen.corner_at[:, :2] += np.linspace(0.0, 12.0 / FOCAL_PX, len(T))[:, None, None]
    found = reconstruct(seen, FOCAL_PX)
    assert found is not None
    inlier = found.structure.inlier > 0
    assert not inlier[:2].any()
    assert np.mean(inlier[2:]) > 0.8
    ratio = found.structure.inverse_depth[inlier] / idepth[inlier]
    assert np.median(np.abs(ratio / np.median(ratio) - 1.0)) < 0.1


def test_turning_alone_leaves_depths_open() -> None:
    rng = np.random.default_rng(4)
    T = [se3.exp([0, 0, 0, *(0.03 * k * rng.normal(size=3))]) for k in range(1, 6)]
    found = reconstruct(scene(rng, 10, 14, T, 0.1)[0], FOCAL_PX)
    assert found is None or np.median(found.structure.relative_sigma) > 0.2


@pytest.mark.parametrize("huber", [1.0, 1e-3], ids=["within", "beyond"])
def test_the_system_holds_the_derivatives_of_the_distances(huber: float) -> None:
    T = poses(MOTIONS["sideways and turning"])[-1:]
    seen, idepth = scene(np.random.default_rng(5), 0, 3, T, 0.0)
    n = len(idepth)
    line = seen.line + np.random.default_rng(6).normal(0.0, 0.02, n)[None, :, None] * [0, 0, 1]
    depth = idepth * 1.05

    def distance(pose: Mat4, d: F64 = depth) -> F64:
        at = numeric.project(pose, seen.end[:, 0], seen.end[:, 1], d, NORMALISED)
        return np.asarray(np.sum(line[0, :, :2] * at, axis=1) + line[0, :, 2])

    H, b, W = np.empty((6, 6)), np.empty(6), np.empty((6, n))
    Hd, bd, squared = np.empty(n), np.empty(n), np.empty((1, n))
    R, t = T[0][None, :3, :3].copy(), T[0][None, :3, 3].copy()
    cost = kl.accumulate(
        seen.end, depth, line, seen.line_seen, R, t, huber, H, b, Hd, bd, W, squared
    )

    r, J = distance(T[0]), numeric.pose_derivatives(distance, T[0])
    w = numeric.huber_weight(r, huber)
    by_depth = numeric.derivative(lambda s: distance(T[0], depth + s))
    assert cost == pytest.approx(numeric.huber_cost(r, huber).sum())
    np.testing.assert_allclose(H, (J * w) @ J.T, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(b, J @ (w * r), rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(Hd, w * by_depth**2, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(bd, w * by_depth * r, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(W, J * w * by_depth, rtol=1e-5, atol=1e-9)
