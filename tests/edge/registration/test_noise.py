# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.geometry import so3
from edge.registration.noise import noise_of, parts_of, rotation_vectors
from tests.edge.registration.simulated_drive import DEPTH_M, SIGMA_M, SimulatedDrive


def test_a_fix_too_far_ahead_makes_its_scale_too_small() -> None:
    """Position and scale share one error; only along the camera's axis."""
    drive = SimulatedDrive(10)
    R7, rows = noise_of(drive.fix(0))
    axis, shared = drive.T_map_cam[0][:3, 2], R7[6, :3]
    assert rows == 7
    assert shared @ axis < 0.0
    assert np.linalg.norm(shared - axis * (axis @ shared)) < 1e-2 * abs(shared @ axis)
    assert abs(shared @ axis) <= SIGMA_M**2 / DEPTH_M + 1e-12


def test_the_parts_of_an_error_are_the_whole() -> None:
    good, _ = noise_of(SimulatedDrive(10).fix(0))
    R7 = np.stack((good, 9.0 * good, np.diag(np.arange(1.0, 8.0) * 1e-4)))
    roots, white = parts_of(R7, RegistrationConfig())
    np.testing.assert_allclose((roots @ roots).sum(axis=0) + white, R7, rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(white).min() > 0.0


def test_a_good_fix_never_counts_against_a_bad_one() -> None:
    good, _ = noise_of(SimulatedDrive(10).fix(0))
    R7 = np.stack((good, 25.0 * good))
    roots, _ = parts_of(R7, RegistrationConfig())
    common = (roots[:, 0] @ roots[:, 1]).sum(axis=0)
    # The best mean has weights of good - common and bad - common.
    assert np.linalg.eigvalsh(good - 0.5 * (common + common.T)).min() > 0.0


@pytest.mark.parametrize("variance", [10.0, 100.0])
def test_bad_fixes_err_together_however_good_others_are(variance: float) -> None:
    """Those from a map's edge rest on the same points, as those from within it do."""
    good, _ = noise_of(SimulatedDrive(10).fix(0))
    R7 = np.stack((*[good] * 5, *[variance * good] * 5))
    roots, _ = parts_of(R7, RegistrationConfig())
    common = (roots[:, -2] @ roots[:, -1]).sum(axis=0)
    share = RegistrationConfig().common_share
    assert np.linalg.eigvalsh(common - 0.99 * share * variance * good).min() > 0.0


def test_without_depths_nothing_is_told_of_the_scale() -> None:
    assert noise_of(SimulatedDrive(10).fix(0, with_scale=False))[1] == 6


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, 3.0])
def test_rotation_vectors_are_logarithms(angle: float) -> None:
    w = angle * np.array([[0.6, 0.0, -0.8], [0.0, 1.0, 0.0]])
    R = np.stack([so3.exp(v) for v in w])
    np.testing.assert_allclose(rotation_vectors(R), w, rtol=1e-6, atol=1e-8)


def test_half_a_turn_is_never_taken_for_none() -> None:
    R = np.stack([so3.exp(math.pi * np.array(axis)) for axis in np.eye(3)])
    np.testing.assert_allclose(np.linalg.norm(rotation_vectors(R), axis=1), math.pi, rtol=1e-6)
