# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.odometry.keyframe import Keyframe
from edge.odometry.prior import MarginalPrior
from edge.odometry.start_prior import hold, of_all_frames
from edge.types import F64, Frame, Mat4

PLACE, KEPT = 2, [0, 3, 4]  # of five frames: the reference, and the window's keyframes


def poses() -> list[Mat4]:
    rng = np.random.default_rng(1)
    found = [se3.exp(0.1 * rng.normal(size=6)) for _ in range(5)]
    found[PLACE] = np.eye(4)
    return found


def information() -> F64:
    rng = np.random.default_rng(2)
    A = rng.normal(size=(40, 24))
    return A.T @ A


def keyframes(T: list[Mat4], steps: F64) -> list[Keyframe]:
    image = np.zeros((2, 2), np.uint8)
    made = [Keyframe(Frame(k, k, image), k, T[k], np.zeros(2)) for k in range(len(T))]
    for keyframe, step in zip(made, steps, strict=True):
        keyframe.delta = np.concatenate((step, np.zeros(2)))
    return made


def test_moving_all_frames_alike_changes_nothing_and_one_what_was_known() -> None:
    H, T = of_all_frames(information(), poses(), PLACE), poses()
    # The odometry frame moved by a twist moves each camera by its adjoint.
    together = np.vstack([se3.adjoint(pose) for pose in T])
    np.testing.assert_allclose(H @ together, 0.0, atol=1e-9)
    alone = np.delete(np.arange(30), np.arange(6 * PLACE, 6 * PLACE + 6))
    np.testing.assert_allclose(H[np.ix_(alone, alone)], information(), atol=1e-9)


def test_keyframes_keep_what_the_others_leave() -> None:
    H = of_all_frames(information(), poses(), PLACE)
    rng = np.random.default_rng(3)
    kept = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in KEPT])
    gone = np.setdiff1d(np.arange(30), kept)
    steps = 0.01 * rng.normal(size=(2, 3, 6))
    T = [poses()[k] for k in KEPT]

    def least(step: F64) -> float:
        """Energy when all other frames give way."""
        best = np.linalg.lstsq(H[np.ix_(gone, gone)], -H[np.ix_(gone, kept)] @ step, rcond=None)[0]
        whole = np.zeros(30)
        whole[kept], whole[gone] = step, best
        return float(whole @ H @ whole)

    energies = []
    for step in steps:
        prior = MarginalPrior(3)
        hold(prior, keyframes(T, np.zeros((3, 6))), H, KEPT)
        energies.append(prior.energy(keyframes(T, step)))
    true = [least(step.ravel()) for step in steps]
    assert energies[0] > 0.0
    assert energies[0] / energies[1] == pytest.approx(true[0] / true[1], rel=1e-6)


def test_a_frame_that_begins_anew_keeps_its_energy() -> None:
    prior, T = MarginalPrior(3), [poses()[k] for k in KEPT]
    moved = keyframes(T, 0.01 * np.random.default_rng(4).normal(size=(3, 6)))
    resting = keyframes(T, np.zeros((3, 6)))
    hold(prior, resting, of_all_frames(information(), poses(), PLACE), KEPT)
    before, gradient = prior.energy(moved), prior.gradient(moved)
    offset = moved[1].delta @ prior.H[8:16, 8:16] @ moved[1].delta
    offset += 2.0 * prior.b[8:16] @ moved[1].delta
    prior.rebase(moved, 1)
    assert not moved[1].delta.any()
    np.testing.assert_allclose(prior.gradient(moved), gradient, atol=1e-9)
    assert prior.energy(moved) == pytest.approx(before - offset, rel=1e-9)
