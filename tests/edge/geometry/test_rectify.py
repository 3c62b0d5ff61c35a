# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from edge.errors import ConfigError
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.geometry.rectify import rectify

LEFT = CameraModel(
    *(752, 480, 458.654, 457.296, 367.215, 248.375, "radtan"),
    (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
)
RIGHT = CameraModel(
    *(752, 480, 457.587, 456.134, 379.999, 255.238, "radtan"),
    (-0.28368365, 0.07451284, -0.00010473, -3.555907e-05),
)
T_LEFT_RIGHT = se3.exp([0.11, -0.002, 0.003, 0.0141, -0.0036, 0.0023])


def points_in_view(n: int = 300) -> np.ndarray:
    """Points (n, 3) in the left camera frame, 1 to 8 m away."""
    rng = np.random.default_rng(0)
    z = rng.uniform(1.0, 8.0, n)
    return np.column_stack((rng.uniform(-0.5, 0.5, n) * z, rng.uniform(-0.4, 0.4, n) * z, z))


def both_pixels(T: np.ndarray = T_LEFT_RIGHT) -> tuple[np.ndarray, np.ndarray]:
    points = points_in_view()
    return LEFT.project(points), RIGHT.project(se3.transform(se3.inverse(T), points))


@pytest.mark.parametrize("seed", range(5))
def test_rows_correspond(seed: int) -> None:
    xi = np.random.default_rng(seed).normal(0.0, 0.03, 6)
    xi[0] += 0.2
    pair = rectify(LEFT, RIGHT, se3.exp(xi))
    left, right = both_pixels(se3.exp(xi))

    rows_left, rows_right = pair.rectify_left(left)[:, 1], pair.rectify_right(right)[:, 1]
    assert rows_left == pytest.approx(rows_right, abs=1e-7)


def test_disparity_gives_depth() -> None:
    pair = rectify(LEFT, RIGHT, T_LEFT_RIGHT)
    left, right = both_pixels()
    disparity = (pair.rectify_left(left) - pair.rectify_right(right))[:, 0]
    depth_m = (points_in_view() @ pair.R_rect_left.T)[:, 2]

    assert pair.pinhole.fx * pair.baseline_m / disparity == pytest.approx(depth_m)
    assert pair.baseline_m == pytest.approx(np.linalg.norm(T_LEFT_RIGHT[:3, 3]))


def test_the_common_view_is_centred_between_cameras_that_both_look_aside() -> None:
    aside = se3.exp([0.0, 0.0, 0.0, 0.0, 0.3, 0.0])
    T = se3.inverse(aside) @ T_LEFT_RIGHT @ aside
    pair = rectify(LEFT, RIGHT, T)
    middle = np.array([[375.5, 239.5]])
    mean = (pair.rectify_left(middle) + pair.rectify_right(middle)) / 2

    assert mean == pytest.approx(middle)
    assert (pair.pinhole.width, pair.pinhole.height) == (752, 480)


def test_the_rotations_differ_from_opencvs_by_a_turn_about_the_baseline_alone() -> None:
    T_right_left = se3.inverse(T_LEFT_RIGHT)
    K = [np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]]) for c in (LEFT, RIGHT)]
    k = [np.array(c.distortion) for c in (LEFT, RIGHT)]
    t = T_right_left[:3, 3:].copy()
    R_left, R_right, *_ = cv2.stereoRectify(
        *(K[0], k[0], K[1], k[1], (752, 480), T_right_left[:3, :3].copy(), t)
    )
    pair = rectify(LEFT, RIGHT, T_LEFT_RIGHT)
    turn_left, turn_right = pair.R_rect_left @ R_left.T, pair.R_rect_right @ R_right.T

    assert turn_left == pytest.approx(turn_right, abs=1e-9)
    assert turn_left[0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    assert turn_left[1, 1] > 0.9999


@pytest.mark.parametrize("t", [[-0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.0]])
def test_a_pair_that_is_not_side_by_side_is_refused(t: list[float]) -> None:
    with pytest.raises(ConfigError, match="T_left_right"):
        rectify(LEFT, RIGHT, se3.from_rotation_translation(np.eye(3), t))
