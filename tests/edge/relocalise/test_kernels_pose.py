# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import so3
from edge.relocalise import kernels_pose as kernels
from edge.relocalise.kernels_likelihood import likelihood_gain
from tests.edge.relocalise.room_matches import CAMERA, error, room_matches

HARMLESS = 1e12  # a robust scale that changes nothing


def parts(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])


@pytest.mark.parametrize(("cauchy2", "gate"), [(30.0, HARMLESS), (HARMLESS, 12.0)])
@pytest.mark.parametrize("axis", range(6), ids=["tx", "ty", "tz", "rx", "ry", "rz"])
def test_b_is_minus_half_the_cost_gradient(axis: int, cauchy2: float, gate: float) -> None:
    room = room_matches(axis, n=40, sigma_px=2.0)
    # Points without uncertainty: with it the weights move too, and Gauss-Newton leaves that out.
    matches = room.matches._replace(C=np.zeros((40, 6)))
    R, p = parts(room.T_map_cam)
    H, b = np.empty((6, 6)), np.empty(6)
    use = np.ones(40)

    def cost(R: np.ndarray, p: np.ndarray) -> float:
        return kernels.normal_equations(*matches[:4], use, CAMERA, R, p, cauchy2, gate, H, b)

    step = np.zeros(6)
    step[axis] = 1e-6
    ahead = cost(so3.exp(step[3:]) @ R, p + step[:3])
    behind = cost(so3.exp(-step[3:]) @ R, p - step[:3])
    cost(R, p)
    assert -2.0 * b[axis] == pytest.approx((ahead - behind) / 2e-6, rel=1e-4)


def test_refine_comes_home_from_far() -> None:
    room = room_matches(1, sigma_px=0.0, wrong_share=0.0)
    matches = room.matches._replace(variance=np.ones(200))
    rng = np.random.default_rng(0)
    for _ in range(20):
        R, p = parts(room.T_map_cam)
        p += rng.normal(0.0, 0.1, 3)
        R = so3.exp(rng.normal(0.0, 0.1, 3)) @ R
        H = np.empty((6, 6))
        kernels.refine(*matches[:4], np.ones(200), CAMERA, R, p, HARMLESS, HARMLESS, 30, H)
        assert np.linalg.norm(p - room.T_map_cam[:3, 3]) < 5e-4  # points are 0.1 mm off


def test_points_uncertain_along_their_rays_pull_less() -> None:
    """Weighted by their covariance, bad points cost little; without it they spoil the pose."""
    weighted, plain = [], []
    for seed in range(10):
        room = room_matches(seed, sigma_along_m=0.15)
        bad = np.arange(200) < 100
        matches = room.matches
        exact = room_matches(seed, sigma_along_m=0.0).matches
        mixed = matches._replace(
            xyz=np.where(bad[:, None], matches.xyz, exact.xyz),
            C=np.where(bad[:, None], matches.C, exact.C),
        )
        for C, errors in ((mixed.C, weighted), (exact.C, plain)):
            R, p = parts(room.T_map_cam)
            given = mixed._replace(C=C)
            H = np.empty((6, 6))
            kernels.refine(*given[:4], np.ones(200), CAMERA, R, p, HARMLESS, HARMLESS, 30, H)
            errors.append(np.linalg.norm(p - room.T_map_cam[:3, 3]))
    assert np.median(weighted) < 0.3 * np.median(plain)


def test_cost_is_the_sum_of_mahalanobis_distances() -> None:
    """Two ways to whiten: by Cholesky and by the inverse."""
    room = room_matches(5, n=60, sigma_px=2.0, sigma_along_m=0.1)
    R, p = parts(room.T_map_cam)
    H, b, m2, variance = np.empty((6, 6)), np.empty(6), np.empty(60), np.empty(60)
    use = np.ones(60)
    cost = kernels.normal_equations(*room.matches[:4], use, CAMERA, R, p, HARMLESS, HARMLESS, H, b)
    kernels.mahalanobis(*room.matches[:4], CAMERA, R, p, m2, variance)
    assert cost == pytest.approx(m2.sum(), rel=1e-3)
    assert 1.0 < m2.mean() < 3.2  # two degrees of freedom


@pytest.mark.parametrize("cauchy2", [30.0, HARMLESS])
def test_a_match_beyond_the_gate_costs_the_gate_however_far_it_is(cauchy2: float) -> None:
    room = room_matches(7, n=60, sigma_px=1.0)
    R, p = parts(room.T_map_cam)
    H, b, use = np.empty((6, 6)), np.empty(6), np.ones(60)
    right = room.matches
    costs = []
    for off_px in (0.0, 60.0, 600.0, 6000.0):
        pixels = right.pixels + np.where(np.arange(60) < 20, off_px, 0.0)[:, None]
        wrong = right._replace(pixels=pixels)
        costs.append(kernels.normal_equations(*wrong[:4], use, CAMERA, R, p, cauchy2, 12.0, H, b))
    assert 150.0 < costs[1] - costs[0] < 240.0  # 20 of 12 at most
    assert costs[1:] == pytest.approx([costs[1]] * 3, rel=1e-6)


def test_wrong_matches_do_not_keep_a_gated_pose_from_its_end() -> None:
    for seed in range(20):
        room = room_matches(seed, n=120, sigma_px=1.0, wrong_share=0.5)
        ends = []
        for use in (np.ones(120), (~room.wrong).astype(np.float64)):
            R, p = parts(room.T_map_cam)
            p += 0.01
            H = np.empty((6, 6))
            kernels.refine(*room.matches[:4], use, CAMERA, R, p, HARMLESS, 12.0, 30, H)
            ends.append(p)
        assert np.linalg.norm(ends[0] - ends[1]) < 2e-3


def test_uncertain_points_gain_less_but_forgive_more() -> None:
    room = room_matches(6, n=60, sigma_px=0.5, sigma_along_m=0.2)
    exact = room.matches._replace(C=np.full((60, 6), 1e-12))
    R, p = parts(room.T_map_cam)

    def gain(matches, p: np.ndarray) -> float:
        return likelihood_gain(*matches[:4], CAMERA, R, p, 3e5, 1e3)

    aside = p + room.T_map_cam[:3, 0] * 0.1
    told = gain(room.matches, p) - gain(room.matches, aside)
    assert gain(exact, p) < gain(room.matches, p)  # their errors are not foreseen
    assert told < 0.5 * (gain(exact._replace(xyz=room.matches.xyz), p) + 5000.0)


def test_inverse_of_H_is_the_covariance() -> None:
    nees = []
    for seed in range(120):
        room = room_matches(seed, n=80, sigma_along_m=0.02)
        R, p = parts(room.T_map_cam)
        H, b = np.empty((6, 6)), np.empty(6)
        use = np.ones(80)
        kernels.refine(*room.matches[:4], use, CAMERA, R, p, HARMLESS, HARMLESS, 30, H)
        kernels.normal_equations(*room.matches[:4], use, CAMERA, R, p, HARMLESS, HARMLESS, H, b)
        T = room.T_map_cam.copy()
        T[:3, :3], T[:3, 3] = R, p
        e = error(T, room.T_map_cam)
        nees.append(e @ H @ e)
    # Mean of 120 chi-squares of 6 degrees has sigma 0.32.
    assert 4.4 < np.mean(nees) < 7.8


def test_a_point_behind_the_camera_gains_nothing() -> None:
    room = room_matches(2, n=30)
    R, p = parts(room.T_map_cam)
    right = likelihood_gain(*room.matches[:4], CAMERA, R, p, 3e5, 9.21)
    about = R @ np.diag([-1.0, 1.0, -1.0])  # looks the other way
    assert right > 60.0  # of 138 at most
    assert likelihood_gain(*room.matches[:4], CAMERA, about, p, 3e5, 9.21) == 0.0
    m2, variance = np.empty((2, 30))
    kernels.mahalanobis(*room.matches[:4], CAMERA, about, p, m2, variance)
    assert np.all(np.isinf(m2))
