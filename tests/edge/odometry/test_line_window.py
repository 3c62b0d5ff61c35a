# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.lines.line import Segments, segments_between
from edge.odometry.keyframe import Keyframe
from edge.odometry.line_window import WindowLines, strong_share
from edge.types import F64, Frame, Mat4, Pinhole

CAMERA = Pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
MASK = np.ones((240, 320), np.uint8)
SIGMA_PX = 0.02
# Ends of six edges two to four metres off; two are parallel, none lies on another's picture.
EDGES = np.array(
    [
        [[-1.0, -0.8, 3.0], [0.9, -0.7, 3.2]],
        [[-1.0, 0.5, 2.5], [0.8, 0.6, 2.4]],
        [[-0.9, -0.6, 3.0], [-0.8, 0.4, 2.6]],
        [[0.8, -0.6, 2.8], [0.9, 0.5, 2.9]],
        [[-0.5, -0.4, 3.6], [0.5, 0.2, 3.4]],
        [[-0.5, 0.3, 2.2], [0.4, 0.3, 2.9]],
    ]
)


def pose(k: int) -> Mat4:
    """A hand-held camera that goes to the right and nods."""
    return se3.exp(np.array([-0.08 * k, 0.01 * (-1) ** k, 0.01 * k, 0.004 * k, -0.01 * k, 0.0]))


def keyframe_at(k: int, T: Mat4) -> Keyframe:
    return Keyframe(Frame(k, k, MASK), k, T, np.zeros(2))


def seen(rng: np.random.Generator, T: Mat4, edges: F64 = EDGES) -> Segments:
    local = se3.transform(T, edges.reshape(-1, 3))
    pixels = local[:, :2] / local[:, 2:] * CAMERA[2:4] + CAMERA[4:]
    pixels = pixels + rng.normal(0.0, SIGMA_PX, pixels.shape)
    return segments_between(pixels.reshape(-1, 4), SIGMA_PX)


def drive(lines: WindowLines, rng: np.random.Generator, n: int) -> list[Keyframe]:
    keyframes: list[Keyframe] = []
    for k in range(n):
        keyframes.append(keyframe_at(k, pose(k)))
        lines.observe(keyframes[-1], seen(rng, pose(k)))
        lines.pack(keyframes)
        lines.read_back(keyframes, 100.0)
    return keyframes


def test_edges_become_lines_where_they_are_and_are_seen_on() -> None:
    lines = WindowLines(CAMERA, MASK, used=True)
    keyframes = drive(lines, np.random.default_rng(1), 7)
    assert len(lines.lines) == len(EDGES)
    assert lines.seen_by(keyframes[-1]) == len(EDGES)
    for line in lines.lines:
        away = EDGES - line.point
        along = away @ line.direction
        across = np.linalg.norm(away - along[..., None] * line.direction, axis=2)
        assert across.max(axis=1).min() < 0.1  # [m]: of a baseline of half a metre


def test_what_a_keyframe_saw_stays_when_it_leaves() -> None:
    lines = WindowLines(CAMERA, MASK, used=True)
    keyframes = drive(lines, np.random.default_rng(2), 6)
    lines.freeze(keyframes[0])
    keyframes[0].delta = np.full(8, 0.1)  # whatever becomes of it
    # They no longer count in the window.
    assert all(len(line.held()) == len(line.views) - 1 for line in lines.lines)
    views = [view for line in lines.lines for view in line.views if view.keyframe is None]
    assert len(views) == len(EDGES)
    for view in views:
        np.testing.assert_allclose(view.T_cam_odom, pose(0), atol=1e-12)


def test_lines_pull_a_wrong_pose_back() -> None:
    lines, rng = WindowLines(CAMERA, MASK, used=True), np.random.default_rng(3)
    keyframes = drive(lines, rng, 6)
    for keyframe in keyframes:
        lines.freeze(keyframe)
    off = np.array([0.01, -0.005, 0.01, 0.002, 0.002, -0.003])
    newest = keyframe_at(6, se3.exp(off) @ pose(6))
    lines.observe(newest, seen(rng, pose(6)))
    lines.pack([newest])
    for _ in range(5):
        H, b = np.zeros((8, 8)), np.zeros(8)
        lines.add([newest], 1e-6, H, b)
        dx = np.zeros(8)
        dx[:6] = -np.linalg.solve(H[:6, :6], b[:6])
        newest.delta = newest.delta + dx
        lines.move(dx, 1e-6)
    left = se3.log(newest.T_cam_odom @ se3.inverse(pose(6)))
    assert np.linalg.norm(left) < 0.5 * np.linalg.norm(off)


def test_a_line_that_went_elsewhere_is_given_up() -> None:
    lines, rng = WindowLines(CAMERA, MASK, used=True), np.random.default_rng(4)
    keyframes = drive(lines, rng, 6)
    gone = EDGES.copy()
    gone[0, :, 1] += 0.03  # still within reach, but not where it was
    for k in range(6, 14):
        keyframes.append(keyframe_at(k, pose(k)))
        lines.observe(keyframes[-1], seen(rng, pose(k), gone))
        lines.pack(keyframes)
        lines.read_back(keyframes, 100.0)
    there = [
        line
        for line in lines.lines
        if np.linalg.norm(np.cross(EDGES[0].mean(axis=0) - line.point, line.direction)) < 0.01
        and line.views[-1].keyframe is keyframes[-1]
    ]
    assert not there


@pytest.mark.parametrize(("n", "is_plain", "times"), [(2, True, 1), (6, False, 1), (6, True, 2)])
def test_many_lines_of_a_plain_image_are_solved_for_widely_first(
    n: int, is_plain: bool, times: int
) -> None:
    lines = WindowLines(CAMERA, MASK, used=True)
    drive(lines, np.random.default_rng(6), n)
    lines.is_plain = is_plain

    assert len(lines.scales) == times
    assert sorted(lines.scales, reverse=True) == list(lines.scales)
    assert lines.scales[-1] == lines.cauchy2  # what an optimisation ends with is what is by default


@pytest.mark.parametrize("used", [True, False])
def test_images_with_texture_are_left_to_points(used: bool) -> None:
    lines, rng = WindowLines(CAMERA, MASK, used=used), np.random.default_rng(5)
    drive(lines, rng, 4)
    assert lines.lines
    level = np.zeros((240, 320, 3), np.float32)
    level[..., 1:] = rng.normal(0.0, 20.0, (240, 320, 2))
    assert strong_share(level, MASK) > 0.5
    lines.look(keyframe_at(4, pose(4)), level)
    assert bool(lines.lines) is not used
    assert lines.work.take() == ()
