# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.lines.line import Segments, lines_between, segments_between
from edge.odometry.line_check import KnownLines, LineCheck, Seen
from edge.types import F64, Mat4, Pinhole

CAMERA = Pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
CHECK = LineCheck(CAMERA, np.ones((240, 320), np.uint8))
SIGMA_PX, DEPTH_M = 0.15, 3.0
# Ends of eight edges around the view, two to four metres off.
EDGES = np.array(
    [
        [[-1.0, -0.8, 3.0], [0.9, -0.7, 3.2]],
        [[-1.0, 0.5, 2.5], [0.8, 0.6, 2.4]],
        [[-0.9, -0.6, 3.0], [-0.8, 0.4, 2.6]],
        [[0.8, -0.6, 2.8], [0.9, 0.5, 2.9]],
        [[-0.5, -0.4, 3.6], [0.5, 0.2, 3.4]],
        [[-0.5, 0.3, 2.2], [0.4, 0.3, 2.9]],
        [[-0.6, -0.5, 3.8], [-0.6, 0.2, 2.4]],
        [[0.3, -0.6, 3.0], [0.5, 0.3, 3.6]],
    ]
)
BEFORE = se3.exp(np.array([0.1, 0.02, -0.05, 0.01, -0.03, 0.02]))  # pose of the frame before
TRUE = se3.exp(np.array([-0.02, 0.004, 0.01, 0.002, -0.004, 0.001])) @ BEFORE
SLIP = np.array([0.05, -0.03, 0.02, 0.004, 0.008, 0.0])


def known(edges: F64 = EDGES) -> KnownLines:
    lines = lines_between(edges[:, 0], edges[:, 1], 1e-3)
    ends = np.stack([((edges[:, i] - lines.point) * lines.direction).sum(1) for i in (0, 1)], 1)
    return KnownLines(lines._replace(covariance=np.zeros((len(edges), 4, 4))), ends)


def shown(seed: int, edges: F64 = EDGES) -> Segments:
    local = se3.transform(TRUE, edges.reshape(-1, 3))
    pixels = local[:, :2] / local[:, 2:] * CAMERA[2:4] + CAMERA[4:]
    pixels = pixels + np.random.default_rng(seed).normal(0.0, SIGMA_PX, pixels.shape)
    return segments_between(pixels.reshape(-1, 4), SIGMA_PX)


def sure(T: Mat4) -> Seen:
    """Points that claim a millimetre."""
    return Seen(T, np.eye(6) * 1e6)


def off_m(T: Mat4) -> float:
    return float(np.linalg.norm(se3.log(T @ se3.inverse(TRUE))[:3]))


@pytest.mark.parametrize("seed", range(4))
def test_what_slipped_along_edges_is_brought_back_however_sure_it_was(seed: int) -> None:
    seen = sure(se3.exp(SLIP) @ TRUE)
    found = CHECK.contradicted_by(shown(seed), seen, known(), BEFORE, DEPTH_M)
    assert found is not None
    assert off_m(found.T_cam_odom) < 0.5 * off_m(seen.T_cam_odom)
    assert np.linalg.eigvalsh(found.information)[0] < 1e6  # it no longer claims as much


@pytest.mark.parametrize("seed", range(4))
def test_what_lines_agree_with_stays_as_it_was(seed: int) -> None:
    seen = sure(se3.exp(0.02 * SLIP) @ TRUE)
    assert CHECK.contradicted_by(shown(seed), seen, known(), BEFORE, DEPTH_M) is None


def test_few_lines_contradict_nothing() -> None:
    seen = sure(se3.exp(SLIP) @ TRUE)
    few = EDGES[:3]
    assert CHECK.contradicted_by(shown(0, few), seen, known(few), BEFORE, DEPTH_M) is None


def test_parallel_edges_leave_the_points_what_they_do_not_see() -> None:
    upright = np.array([[[x, -0.7, z], [x, 0.6, z]] for x, z in zip(
        np.linspace(-1.0, 1.0, 7), (3.0, 2.6, 3.4, 2.8, 3.3, 2.7, 3.1), strict=True
    )])  # fmt: skip
    along = se3.exp(np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])) @ TRUE
    assert (
        CHECK.contradicted_by(shown(0, upright), sure(along), known(upright), BEFORE, 3.0) is None
    )


def test_an_image_without_edges_says_nothing() -> None:
    plain = np.full((240, 320, 3), 90.0, np.float32)
    seen = sure(se3.exp(SLIP) @ TRUE)
    assert CHECK.contradicted(seen, plain, known(), BEFORE, DEPTH_M) is None
