# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.lines.line import across, segments_between
from edge.odometry import kernels_lines as kl
from edge.types import F64, Mat4, Pinhole
from tests.edge.odometry import numeric

CAMERA = Pinhole(320, 240, 260.0, 262.0, 159.5, 119.5)
SIGMA_PX, UNIT, CAUCHY2 = 0.2, 40.0, 9.0
N_FRAMES = 3
# Two lines, seen by all frames of the window.
FRAME = np.array([0, 1, 2] * 2, np.int32)
START = np.array([0, 3, 6], np.int32)


class Scene:
    """Lines and what views see of them."""

    def __init__(self, noise_px: float) -> None:
        rng = np.random.default_rng(1)
        self.ends = np.array([[[-1, -0.5, 3], [1, -0.3, 4]], [[0.5, -1, 2.5], [0.6, 1, 3.0]]])
        self.T = np.array([se3.exp(0.1 * rng.normal(size=6)) for _ in range(3)] * 2)
        pixels = []
        for view, T in enumerate(self.T):
            local = se3.transform(T, self.ends[view // 3])
            at = local[:, :2] / local[:, 2:] * CAMERA[2:4] + CAMERA[4:]
            pixels.append((at + rng.normal(0.0, noise_px, (2, 2))).ravel())
        self.segments = segments_between(np.array(pixels), SIGMA_PX)
        self.point = self.ends.mean(axis=1)
        run = self.ends[:, 1] - self.ends[:, 0]
        self.direction = run / np.linalg.norm(run, axis=1, keepdims=True)
        self.H_lines, self.b_lines = np.empty((2, 4, 4)), np.empty((2, 4))
        self.H_frames, self.m2 = np.empty((6, 6, 4)), np.empty(6)

    def system(self, T: F64, damping: float = 0.0) -> tuple[float, F64, F64]:
        """Cost, H and b with the lines eliminated."""
        H, b = np.zeros((8 * N_FRAMES, 8 * N_FRAMES)), np.zeros(8 * N_FRAMES)
        cost = kl.line_system(
            START, FRAME, T, *self.segments, self.point, self.direction, CAMERA, UNIT, CAUCHY2,
            damping, H, b, self.H_lines, self.b_lines, self.H_frames, self.m2,
        )  # fmt: skip
        return cost, H, b

    def moved(self, steps: F64) -> F64:
        """Poses of all views after twists (3, 6) of the window's frames."""
        poses: list[Mat4] = [se3.exp(steps[f]) @ T for T, f in zip(self.T, FRAME, strict=True)]
        return np.array(poses)


def test_exact_segments_cost_nothing() -> None:
    scene = Scene(0.0)
    cost, _, b = scene.system(scene.T)
    assert cost == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(b, 0.0, atol=1e-6)
    np.testing.assert_allclose(scene.m2, 0.0, atol=1e-12)


def test_gradients_are_half_the_costs_slope() -> None:
    scene = Scene(1.0)
    scene.system(scene.T)
    basis = across(scene.direction)
    for k in range(4):

        def shifted(s: float, k: int = k) -> F64:
            other = Scene(1.0)
            if k < 2:
                other.point = scene.point + s * basis[:, k]
            else:
                tilted = scene.direction + s * basis[:, k - 2]
                other.direction = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
            return np.asarray(other.system(scene.T)[0])

        slope = numeric.derivative(shifted)
        assert 2.0 * scene.b_lines[:, k].sum() == pytest.approx(float(slope), rel=1e-3)


def test_the_frames_gradient_is_the_slope_that_lines_do_not_take_up() -> None:
    scene = Scene(0.0)
    rng = np.random.default_rng(2)
    steps = 1e-5 * rng.normal(size=(N_FRAMES, 6))
    cost, H, b = scene.system(scene.moved(steps))
    # Back to the truth: the lines' part is eliminated, so what is left is a quadratic whose
    # minimum is the cost of lines that move, too.
    dx = np.zeros((N_FRAMES, 8))
    dx[:, :6] = -steps
    foretold = float(cost + 2.0 * b @ dx.ravel() + dx.ravel() @ H @ dx.ravel())
    taken = 0.0
    for information, gradient in zip(scene.H_lines, scene.b_lines, strict=True):
        taken += float(gradient @ np.linalg.solve(information, gradient))
    assert foretold - taken == pytest.approx(0.0, abs=0.02 * cost)


def test_a_step_of_frames_and_lines_together_reaches_the_minimum() -> None:
    scene = Scene(0.0)
    steps = 2e-3 * np.random.default_rng(3).normal(size=(N_FRAMES, 6))
    scene.point = scene.point + 0.01 * across(scene.direction)[:, 0]
    T = scene.moved(steps)
    before, H, b = scene.system(T, 1e-9)
    # Nothing holds the frames' own place: a little damping stands for the rest of the window.
    dx = -np.linalg.solve(H + 1e-6 * np.trace(H) * np.eye(len(H)), b)
    kl.move_lines(
        START, FRAME, scene.H_lines, scene.b_lines, scene.H_frames, dx, UNIT, 1e-9,
        scene.point, scene.direction,
    )  # fmt: skip
    after, _, _ = scene.system(
        np.array([se3.exp(dx[8 * f : 8 * f + 6]) @ P for P, f in zip(T, FRAME, strict=True)])
    )
    assert after < 0.05 * before
    np.testing.assert_allclose(np.linalg.norm(scene.direction, axis=1), 1.0)
