# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.config.lines import PairingConfig
from edge.geometry import se3
from edge.lines import kernels_associate, pose
from edge.lines.associate import associate
from edge.lines.line import Lines, Segments, lines_between, segments_between, take, take_segments
from edge.types import F64, Mat4
from tests.edge.lines.line_scenes import CAMERA, ends_before, project, viewpoint

CONFIG = PairingConfig()


def scene(seed: int, n: int) -> tuple[Lines, F64, Segments, Mat4, F64]:
    """Lines, spans, segments of other parts of them in another order, the pose, the order."""
    rng = np.random.default_rng(seed)
    T = viewpoint(rng)
    ends = ends_before(rng, T, n, flat=False)
    lines = lines_between(ends[:, 0], ends[:, 1], 1e-3)
    half = 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    share = np.array([0.15, 0.95])[:, None]
    parts = ends[:, :1] + share * (ends[:, 1:] - ends[:, :1])
    pixels = project(se3.transform(T, parts.reshape(-1, 3))).reshape(-1, 4)
    order = rng.permutation(n)
    segments = segments_between(pixels[order] + rng.normal(0, 0.3, (n, 4)), 0.3)
    return lines, np.column_stack((-half, half)), segments, T, order


@pytest.mark.parametrize("seed", range(5))
def test_lines_find_their_segments_from_a_pose_that_is_some_pixels_off(seed: int) -> None:
    lines, span, segments, T, order = scene(seed, 25)
    guess = se3.exp([0.01, -0.008, 0.01, 0.004, -0.006, 0.006]) @ T
    pairs = associate(lines, span, segments, CAMERA, guess, 12.0, CONFIG)
    right = order[pairs.segment] == pairs.line
    assert len(pairs.expected) == 25
    assert np.count_nonzero(right) >= 20
    assert np.mean(right) >= 0.9
    found = pose.refine(
        take(lines, pairs.line), take_segments(segments, pairs.segment), CAMERA, guess
    )
    np.testing.assert_allclose(found.T_cam_lines, T, atol=0.01)


def test_no_segment_serves_two_lines() -> None:
    lines, span, segments, T, _ = scene(3, 12)
    twice = Lines(*(np.concatenate((array, array)) for array in lines))
    pairs = associate(twice, np.vstack((span, span)), segments, CAMERA, T, 12.0, CONFIG)
    assert len(np.unique(pairs.segment)) == len(pairs.segment) == 12


def test_gates_of_angle_and_reach_hold() -> None:
    lines = lines_between(np.array([[-0.5, 0, 2.0]]), np.array([[0.5, 0, 2.0]]), 1e-3)
    span = np.array([[-0.5, 0.5]])
    v = CAMERA.cy

    def paired(du: float, dv: float) -> int:
        segments = segments_between([[250, v + du, 390, v + dv]], 0.3)
        return len(associate(lines, span, segments, CAMERA, np.eye(4), 12.0, CONFIG).line)

    assert paired(5.0, 5.0) == 1
    assert paired(-11.0, -11.0) == 1
    assert paired(14.0, 14.0) == 0
    assert paired(-6.0, 6.0) == 1  # 4.9 degrees
    assert paired(-10.0, 10.0) == 0  # 8.1 degrees


def test_an_edge_whose_other_side_is_brighter_is_another() -> None:
    lines = lines_between(np.array([[-0.5, 0, 2.0]]), np.array([[0.5, 0, 2.0]]), 1e-3)
    segments = segments_between([[390, CAMERA.cy, 250, CAMERA.cy]], 0.3)
    span = np.array([[-0.5, 0.5]])
    assert len(associate(lines, span, segments, CAMERA, np.eye(4), 12.0, CONFIG).line) == 0


def test_the_offset_is_signed_along_the_normal() -> None:
    lines = lines_between(np.array([[-0.5, 0, 2.0]]), np.array([[0.5, 0, 2.0]]), 1e-3)
    segments = segments_between([[250, CAMERA.cy + 4, 390, CAMERA.cy + 4]], 0.3)
    pairs = associate(lines, np.array([[-0.5, 0.5]]), segments, CAMERA, np.eye(4), 12.0, CONFIG)
    assert pairs.offset_px == pytest.approx([4.0], abs=1e-9)


def test_projection_cuts_off_what_is_behind_or_beside_the_image() -> None:
    first = np.array([[0, 0.1, 2.0], [0, 0, -2.0], [9, 0, 2.0], [-0.1, 0.0, -1.0]])
    last = np.array([[9, 0.1, 2.0], [0, 1, -1.0], [9, 1, 2.0], [-0.1, 0.0, 3.0]])
    out = np.empty((4, 4))
    assert kernels_associate.project(first, last, np.eye(4), CAMERA, 4.0, out) == 2
    np.testing.assert_allclose(out[0], [CAMERA.cx, CAMERA.cy + 25, 635, CAMERA.cy + 25])
    assert np.all(np.isnan(out[1:3]))
    # From the point before the camera to the image's border: towards where it came from.
    np.testing.assert_allclose(out[3], [4.0, CAMERA.cy, CAMERA.cx - 50 / 3, CAMERA.cy])
