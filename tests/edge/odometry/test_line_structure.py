# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.odometry import kernels_line_start as kl
from edge.odometry.line_structure import Seen, reconstruct, scatter_rad, span, way_of
from edge.odometry.room_axes import unknown
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


def poses(motion: list[float], sway: float = SWAY) -> list[Mat4]:
    rng = np.random.default_rng(3)
    shares = (0.2, 0.4, 0.6, 0.8, 1.0)
    return [se3.exp(np.array(motion) * s + sway * rng.normal(size=6)) for s in shares]


def scene(
    rng: np.random.Generator, edges: int, meetings: int, T: list[Mat4], noise_px: float
) -> tuple[Seen, F64]:
    """What is seen of edges in space and of where others meet, and all inverse depths."""
    n = 2 * edges + meetings
    rays = rng.uniform((-0.6, -0.45), (0.6, 0.45), (n, 2))
    idepth = 1.0 / rng.uniform(1.0, 4.0, n)
    at = np.stack([numeric.project(pose, rays[:, 0], rays[:, 1], idepth, NORMALISED) for pose in T])
    at += rng.normal(0.0, noise_px / FOCAL_PX, at.shape)
    line = np.zeros((len(T), n, 2, 3))
    along = at[:, 1 : 2 * edges : 2] - at[:, : 2 * edges : 2]
    ends = slice(0, 2 * edges)
    line[:, ends, 0] = _through(at[:, ends], np.repeat(along, 2, axis=1))
    for k in range(2):
        ways = rng.normal((1 - k, k), 1.0, (meetings, 2))
        line[:, 2 * edges :, k] = _through(
            at[:, 2 * edges :], np.broadcast_to(ways, at[:, 2 * edges :].shape)
        )
    seen = np.ones((len(T), n), np.uint8)
    return Seen(edges, 0, rays, line, seen, unknown(len(T))), idepth


def _through(at: F64, along: F64) -> F64:
    """Lines a x + b y + c (..., 3) through places (..., 2)."""
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    normal = np.stack((-along[..., 1], along[..., 0]), axis=-1)
    return np.concatenate((normal, -np.sum(normal * at, axis=-1, keepdims=True)), axis=-1)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_few_exact_edges_and_meetings_give_exact_depths_and_poses(motion: list[float]) -> None:
    T = poses(motion)
    seen, idepth = scene(np.random.default_rng(1), 14, 6, T, 0.0)
    found = reconstruct(seen, FOCAL_PX)
    assert found is not None
    structure = found.structure
    assert structure.inlier.all()
    assert found.fit_px < 0.01
    assert found.rival_px > 0.05
    scale = float(np.median(idepth))
    np.testing.assert_allclose(structure.inverse_depth * scale, idepth, rtol=2e-2)
    last = structure.T_frame_reference[-1]
    np.testing.assert_allclose(last[:3, :3], T[-1][:3, :3], atol=1e-3)
    np.testing.assert_allclose(last[:3, 3] / scale, T[-1][:3, 3], atol=1e-3)


def test_meetings_that_are_none_bend_nothing() -> None:
    T = poses(MOTIONS["sideways"])
    seen, idepth = scene(np.random.default_rng(2), 14, 8, T, 0.05)
    # Where one edge passes behind another they seem to meet, and that slides.
    seen.line[:, -2:, :, 2] += np.linspace(0.0, 12.0 / FOCAL_PX, len(T))[:, None, None]
    found = reconstruct(seen, FOCAL_PX)
    assert found is not None
    inlier = found.structure.inlier > 0
    assert not inlier[-2:].any()
    assert np.mean(inlier[:-2]) > 0.8
    ratio = found.structure.inverse_depth[inlier] / idepth[inlier]
    assert np.median(np.abs(ratio / np.median(ratio) - 1.0)) < 0.1


def test_the_reference_may_be_any_of_the_frames() -> None:
    T = poses(MOTIONS["sideways and turning"])
    whole = [np.eye(4), *T]
    others = [pose for k, pose in enumerate(whole) if k != 3]
    T_frame_reference = [pose @ se3.inverse(whole[3]) for pose in others]
    np.testing.assert_allclose(span(T_frame_reference, 3), whole[-1], atol=1e-12)


def test_turning_alone_leaves_depths_open() -> None:
    rng = np.random.default_rng(4)
    T = [se3.exp([0, 0, 0, *(0.03 * k * rng.normal(size=3))]) for k in range(1, 6)]
    found = reconstruct(scene(rng, 14, 6, T, 0.1)[0], FOCAL_PX)
    assert found is None or np.median(found.structure.relative_sigma) > 0.2


@pytest.mark.parametrize("limit", [1.0, 1e-2], ids=["within", "beyond"])
def test_the_system_holds_the_derivatives_of_the_distances(limit: float) -> None:
    T = poses(MOTIONS["sideways and turning"])[-1:]
    seen, idepth = scene(np.random.default_rng(5), 0, 6, T, 0.0)
    n = len(idepth)
    line = seen.line.copy()
    line[..., 2] += np.random.default_rng(6).normal(0.0, 0.02, (1, n, 2))
    depth = idepth * 1.05

    def distance(pose: Mat4, d: F64 = depth) -> F64:
        at = numeric.project(pose, seen.rays[:, 0], seen.rays[:, 1], d, NORMALISED)
        return np.asarray(
            np.sum(line[0, :, :, :2] * at[:, None], axis=2) + line[0, :, :, 2]
        ).ravel()

    H, b, W = np.empty((6, 6)), np.empty(6), np.empty((6, n))
    Hd, bd, squared = np.empty(n), np.empty(n), np.empty((1, n))
    R, t = T[0][None, :3, :3].copy(), T[0][None, :3, 3].copy()
    cost = kl.accumulate(
        seen.rays, depth, line, seen.visible, R, t, limit, H, b, Hd, bd, W, squared
    )

    r, J = distance(T[0]), numeric.pose_derivatives(distance, T[0])
    total = (r.reshape(n, 2) ** 2).sum(axis=1)
    w = np.repeat(1.0 / (1.0 + total / limit**2) ** 2, 2)
    by_depth = numeric.derivative(lambda s: distance(T[0], depth + s))
    assert cost == pytest.approx((total / (1.0 + total / limit**2)).sum())
    np.testing.assert_allclose(squared[0], total, rtol=1e-9)
    np.testing.assert_allclose(H, (J * w) @ J.T, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(b, J @ (w * r), rtol=1e-5, atol=1e-8)
    pairs = (n, 2)
    np.testing.assert_allclose(Hd, (w * by_depth**2).reshape(pairs).sum(1), rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(bd, (w * by_depth * r).reshape(pairs).sum(1), rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(
        W, (J * w * by_depth).reshape(6, n, 2).sum(axis=2), rtol=1e-5, atol=1e-9
    )


def way_off_and_scatter(sway: float) -> tuple[F64, F64]:
    """By how much ways (n,) are off, and how far they scatter by leaving parts out [rad]."""
    off, scatter = [], []
    for seed in range(10):
        T = poses(MOTIONS["sideways"], sway)
        seen, _ = scene(np.random.default_rng(seed), 14, 2, T, 0.1)
        found = reconstruct(seen, FOCAL_PX)
        assert found is not None
        cosine = way_of(found.structure.T_frame_reference, 0) @ way_of(T, 0)
        off.append(np.arccos(min(cosine, 1.0)))
        scatter.append(scatter_rad(found, seen, FOCAL_PX))
    return np.array(off), np.array(scatter)


def test_leaving_parts_out_tells_how_uncertain_the_way_is() -> None:
    """The less a hand sways the less do edges say."""
    off, steady = way_off_and_scatter(SWAY)
    off_still, loose = way_off_and_scatter(0.2 * SWAY)
    assert np.median(loose) > 2.0 * np.median(steady)
    assert np.median(steady) < np.deg2rad(3.0)
    assert np.all(off < 2.0 * steady)
    assert np.all(off_still < 2.0 * loose)
