# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.odometry.structure import Structure, reconstruct, rival_residual
from edge.types import F64, Mat4
from tests.edge.odometry import numeric

FOCAL_PX = 260.0
NORMALISED = np.array([1.0, 1.0, 0.0, 0.0], np.float32)
MOTIONS = {
    "sideways": [0.09, 0.0, 0.0, 0.0, 0.02, 0.0],
    "sideways and turning": [0.08, 0.02, 0.01, 0.01, -0.05, 0.02],
    "forward": [0.01, 0.0, -0.35, 0.0, 0.004, 0.0],
}


def views(
    motion: list[float], n: int, noise_px: float, seed: int, field: float = 0.6
) -> tuple[F64, F64, F64]:
    """Rays (n, 2), their inverse depths (n,), and noisy observations (5, n, 2)."""
    rng = np.random.default_rng(seed)
    rays = rng.uniform((-field, -0.75 * field), (field, 0.75 * field), (n, 2))
    idepth = 1.0 / rng.uniform(1.0, 4.0, n)
    poses = [se3.exp(np.array(motion) * share) for share in (0.2, 0.4, 0.6, 0.8, 1.0)]
    observed = np.stack([seen_from(T, rays, idepth) for T in poses])
    return rays, idepth, observed + rng.normal(0.0, noise_px / FOCAL_PX, observed.shape)


def seen_from(T: Mat4, rays: F64, idepth: F64) -> F64:
    return numeric.project(T, rays[:, 0], rays[:, 1], idepth, NORMALISED)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_exact_corners_give_exact_depths_and_poses(motion: list[float]) -> None:
    rays, idepth, observed = views(motion, 120, 0.0, 1)
    seen = np.ones(observed.shape[:2], np.uint8)
    structure = reconstruct(rays, observed, seen, FOCAL_PX)
    assert structure is not None
    assert structure.inlier.all()
    assert np.median(structure.inverse_depth) == pytest.approx(1.0)
    scale = float(np.median(idepth))
    np.testing.assert_allclose(structure.inverse_depth * scale, idepth, rtol=1e-5)
    last = structure.T_frame_reference[-1]
    np.testing.assert_allclose(last[:3, :3], se3.exp(motion)[:3, :3], atol=1e-7)
    np.testing.assert_allclose(last[:3, 3] / scale, se3.exp(motion)[:3, 3], atol=1e-6)


# In a narrow field of view sideways motion hardly differs from turning: poses are uncertain too.
@pytest.mark.parametrize("field", [0.6, 0.15], ids=["wide", "narrow"])
@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_depths_are_as_wrong_as_their_sigma_says(motion: list[float], field: float) -> None:
    z = []
    for seed in range(8):
        rays, idepth, observed = views(motion, 120, 0.4, seed, field)
        seen = np.ones(observed.shape[:2], np.uint8)
        structure = reconstruct(rays, observed, seen, FOCAL_PX)
        if structure is None:  # of a narrow view some tell nothing
            continue
        good = structure.inlier > 0
        ratio = structure.inverse_depth[good] / idepth[good]
        # The scale is free: it is what makes the certain points fit best.
        sigma = structure.relative_sigma[good]
        wrong = np.log(ratio) - np.average(np.log(ratio), weights=1.0 / sigma**2)
        near = sigma < 0.3  # beyond, a depth's error is no longer normal
        z.append((wrong / sigma)[near])
    assert len(z) >= (5 if field < 0.5 else 7)
    spread = 1.4826 * np.median(np.abs(np.concatenate(z)))
    # Real corners err alike in neighbouring frames: claiming up to three times the error is right.
    assert 0.25 < spread < 2.0
    assert np.mean(np.abs(np.concatenate(z)) < 3.0) > 0.93


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_no_other_interpretation_fits_a_wide_view_of_a_deep_scene(motion: list[float]) -> None:
    rays, _, observed = views(motion, 120, 0.2, 5)
    seen = np.ones(observed.shape[:2], np.uint8)
    structure = reconstruct(rays, observed, seen, FOCAL_PX)
    assert structure is not None
    rival_px = rival_residual(structure, rays, observed, seen, FOCAL_PX)
    assert rival_px > 2.0 * structure.residual_px


def test_a_reversed_relief_finds_its_rival_and_a_narrow_view_has_one() -> None:
    motion = MOTIONS["sideways"]
    rays, _, observed = views(motion, 120, 0.2, 6, field=0.1)
    seen = np.ones(observed.shape[:2], np.uint8)
    structure = reconstruct(rays, observed, seen, FOCAL_PX)
    assert structure is not None
    rival_px = rival_residual(structure, rays, observed, seen, FOCAL_PX)
    assert rival_px < 1.4 * structure.residual_px
    # The truth is the rival of a wrong structure, and fits better than it.
    wide, _, seen_wide = views(motion, 120, 0.2, 6)
    ones = np.ones(seen_wide.shape[:2], np.uint8)
    right = reconstruct(wide, seen_wide, ones, FOCAL_PX)
    assert right is not None
    wrong = Structure(
        tuple(se3.inverse(T) for T in right.T_frame_reference),
        2.0 * right.inverse_depth.mean() - right.inverse_depth,
        right.relative_sigma,
        right.inlier,
        right.residual_px,
    )
    assert rival_residual(wrong, wide, seen_wide, ones, FOCAL_PX) < 1.05 * right.residual_px


@pytest.mark.parametrize("when", [slice(None), slice(1, 3)], ids=["always", "in between"])
def test_wrong_corners_are_found_out(when: slice) -> None:
    rays, idepth, observed = views(MOTIONS["sideways"], 150, 0.2, 3)
    rng = np.random.default_rng(4)
    wrong = np.arange(0, 150, 10)
    observed[when, wrong] += rng.normal(0.0, 12.0 / FOCAL_PX, observed[when, wrong].shape)
    seen = np.ones(observed.shape[:2], np.uint8)
    structure = reconstruct(rays, observed, seen, FOCAL_PX)
    assert structure is not None
    assert np.count_nonzero(structure.inlier[wrong]) <= 3
    right = np.setdiff1d(np.arange(150), wrong)
    assert np.count_nonzero(structure.inlier[right]) > 0.9 * len(right)
    ratio = structure.inverse_depth[right] / idepth[right]
    assert np.median(np.abs(ratio / np.median(ratio) - 1.0)) < 0.1


def test_corners_that_are_missing_in_some_frames_are_no_trouble() -> None:
    rays, idepth, observed = views(MOTIONS["sideways"], 120, 0.2, 5)
    seen = np.ones(observed.shape[:2], np.uint8)
    seen[1, ::2] = 0
    seen[:-1, ::7] = 0
    observed[seen == 0] = 0.0
    structure = reconstruct(rays, observed, seen, FOCAL_PX)
    assert structure is not None
    good = structure.inlier > 0
    assert np.count_nonzero(good) > 80
    ratio = structure.inverse_depth[good] / idepth[good]
    assert np.median(np.abs(ratio / np.median(ratio) - 1.0)) < 0.1


@pytest.mark.parametrize("motion", [[0.0] * 6, [0, 0, 0, 0.02, 0.06, 0.01]], ids=["still", "turn"])
def test_without_translation_no_depth_is_certain(motion: list[float]) -> None:
    for seed in range(5):
        rays, _, observed = views(motion, 120, 0.3, seed)
        structure = reconstruct(rays, observed, np.ones(observed.shape[:2], np.uint8), FOCAL_PX)
        if structure is not None:
            assert np.median(structure.relative_sigma[structure.inlier > 0]) > 0.15


def test_too_few_corners_give_nothing() -> None:
    rays, _, observed = views(MOTIONS["sideways"], 12, 0.1, 6)
    seen = np.ones(observed.shape[:2], np.uint8)
    assert reconstruct(rays, observed, seen, FOCAL_PX) is None
