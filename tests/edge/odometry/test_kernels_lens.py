# SPDX-License-Identifier: Apache-2.0
"""The lens's equations against residuals worked out pixel by pixel and shifted by hand."""

import numpy as np

from edge.geometry import se3
from edge.odometry import kernels_window as kw
from edge.odometry.system import WindowSystem
from edge.odometry.window import Window
from edge.types import F64
from tests.edge.odometry.built_window import POSES, build_window
from tests.edge.odometry.scenes import Corner

TURNING = np.array([[0.3, -0.5, 0.2], [-0.2, 0.4, 0.6], [0.5, 0.1, -0.4]])
VELOCITY = np.array([[0.2, 0.1, -0.3], [-0.1, 0.3, 0.2], [0.25, -0.2, 0.1]])
# Steps of the numeric derivatives: log focal, bend, read-out by turning and by translation [s].
STEPS = np.array([2e-4, 5e-4, 2e-4, 2e-4])


def window_of_three() -> Window:
    window = build_window(Corner(3), POSES[:3], points_per_frame=30)
    for k, turning, velocity in zip(window.keyframes, TURNING, VELOCITY, strict=True):
        k.turning, k.velocity = turning, velocity
    # Off the optimum, so that there is a gradient.
    window.points[kw.IDEPTH] *= np.float32(1.01)
    return window


def shifted(x: F64, y: F64, idepth: F64, frame: int, theta: F64) -> tuple[F64, F64]:
    """Where the lens `theta` (4,) puts rays (x, y, 1) of a frame: straight rays to seen ones."""
    fy, cy = 200.0, 89.5
    late = (fy * y + cy) / 180.0 - 0.5
    omega, v = TURNING[frame], VELOCITY[frame]
    grown = np.exp(theta[0]) * (1.0 + theta[1] * (x * x + y * y))
    turn = -np.cross(np.broadcast_to(omega, (*x.shape, 3)), np.stack((x, y, np.ones_like(x)), -1))
    dx = theta[2] * (turn[..., 0] - x * turn[..., 2]) + theta[3] * idepth * (v[0] - x * v[2])
    dy = theta[2] * (turn[..., 1] - y * turn[..., 2]) + theta[3] * idepth * (v[1] - y * v[2])
    return x * grown + late * dx, y * grown + late * dy


def pixels(window: Window, p: int, target: int, theta: F64, xi: F64, depth_step: float) -> F64:
    """Where point `p`'s pattern centre lies in `target`, everything else moved by hand."""
    host = int(window.host[p])
    f, c = 200.0, np.array([119.5, 89.5])
    seen = (window.points[:2, p].astype(np.float64) - c) / f
    idepth = float(window.points[kw.IDEPTH, p]) + depth_step
    # The straight ray whose image is the host's pixel; first order is enough for derivatives.
    x, y = seen
    bx, by = shifted(np.array(x), np.array(y), np.array(idepth), host, theta)
    x, y = 2.0 * x - float(bx), 2.0 * y - float(by)
    poses = [k.T_cam_odom for k in window.keyframes]
    poses = [se3.exp(xi[6 * n : 6 * n + 6]) @ T for n, T in enumerate(poses)]
    X = poses[target] @ se3.inverse(poses[host]) @ np.array([x, y, 1.0, idepth])
    u, v = shifted(X[0] / X[2], X[1] / X[2], idepth / X[2], target, theta)
    return np.array([f * float(u) + c[0], f * float(v) + c[1]])


def numeric(window: Window, p: int, target: int) -> tuple[F64, F64, F64]:
    """Jacobians of the pixel: lens (2, 4), poses (2, 18), inverse depth (2,)."""

    def slope(column: int, step: float, kind: str) -> F64:
        out = []
        for sign in (1.0, -1.0):
            theta, xi, depth = np.zeros(4), np.zeros(18), 0.0
            if kind == "lens":
                theta[column] = sign * step
            elif kind == "pose":
                xi[column] = sign * step
            else:
                depth = sign * step
            out.append(pixels(window, p, target, theta, xi, depth))
        return (out[0] - out[1]) / (2.0 * step)

    lens = np.stack([slope(m, STEPS[m], "lens") for m in range(4)], axis=1)
    pose = np.stack([slope(m, 1e-5, "pose") for m in range(18)], axis=1)
    return lens, pose, slope(0, 1e-5, "depth")


def brightening(grey: float, at: F64) -> float:
    """How a grey value at a pixel grows with the correction of the fall-off, numerically."""
    corner_2 = 120.0**2 + 90.0**2
    share = float(np.sum((at - (119.5, 89.5)) ** 2)) / corner_2
    return grey * (np.exp(1e-4 * share) - np.exp(-1e-4 * share)) / 2e-4


def gram(window: Window, p: int, target: int) -> F64:
    """Weighted sums over the pattern of products of (du, dv, fall-off, a, b, residual): (6, 6)."""
    host = int(window.host[p])
    keyframes = window.keyframes
    T = keyframes[target].T_cam_odom @ keyframes[host].T_odom_cam
    level = window.images[keyframes[target].slot].astype(np.float64)
    idepth = float(window.points[kw.IDEPTH, p])
    at_host = window.points[:2, p].astype(np.float64)
    out = np.zeros((6, 6))
    for q in range(kw.PATTERN_SIZE):
        x = (window.points[kw.U, p] + kw.PATTERN_U[q] - 119.5) / 200.0
        y = (window.points[kw.V, p] + kw.PATTERN_V[q] - 89.5) / 200.0
        X = T @ np.array([x, y, 1.0, idepth])
        u, v = 200.0 * X[0] / X[2] + 119.5, 200.0 * X[1] / X[2] + 89.5
        x0, y0 = int(u), int(v)
        a, b = u - x0, v - y0
        corners = level[y0 : y0 + 2, x0 : x0 + 2]
        weights = np.array([[(1 - a) * (1 - b), a * (1 - b)], [(1 - a) * b, a * b]])
        grey, gx, gy = np.tensordot(weights, corners, axes=2)
        colour = float(window.points[kw.GREY + q, p])
        scale2 = window.config.gradient_scale_grey**2
        w = 0.5 * (np.sqrt(scale2 / (scale2 + gx * gx + gy * gy)) + window.points[kw.WEIGHT + q, p])
        falloff = brightening(grey, np.array([u, v])) - brightening(colour, at_host)
        J = np.array([gx, gy, falloff, -colour, -1.0, grey - colour])
        robust = min(1.0, window.config.huber_grey / max(abs(grey - colour), 1e-9))
        out += float(w) ** 2 * robust * np.outer(J, J)
    return out


def test_the_lens_equations_are_those_of_shifted_pixels() -> None:
    window = window_of_three()
    system = WindowSystem(window.images, window.mask, window.intrinsics, window.config)
    packing = system.pack(window.points, window.host, window.residual, window.keyframes)
    system.linearise(packing, window.keyframes)
    H, b, H_frames, H_depths = system.lens_columns(packing, window.keyframes)
    expected_H, expected_b = np.zeros((5, 5)), np.zeros(5)
    expected_frames, expected_depths = np.zeros((5, 24)), np.zeros_like(H_depths, np.float64)
    lens = np.eye(3, 5, k=2)  # the last unknown moves no pixel
    for lane, p in enumerate(packing.order):
        for target in range(3):
            if p < 0 or packing.state[target, lane] != kw.INLIER:
                continue
            lens[:2, :4], pose, depth = numeric(window, p, target)
            G = gram(window, p, target)
            pull = lens.T @ G[:3]
            expected_H += pull[:, :3] @ lens
            expected_b += pull[:, 5]
            expected_depths[:, lane] += pull[:, :2] @ depth
            frames = (pull[:, :2] @ pose).reshape(5, 3, 6)
            expected_frames.reshape(5, 3, 8)[:, :, :6] += frames
            expected_frames.reshape(5, 3, 8)[:, target, 6:] += pull[:, 3:5]
            expected_frames.reshape(5, 3, 8)[:, int(window.host[p]), 6:] -= pull[:, 3:5]
    for got, expected in (
        (H, expected_H),
        (b, expected_b),
        (H_frames, expected_frames),
        (H_depths, expected_depths),
    ):
        for row in range(5):
            size = np.abs(expected[row]).max()
            np.testing.assert_allclose(got[row], expected[row], atol=0.01 * size)
