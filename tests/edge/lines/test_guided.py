# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.config.lines import PairingConfig
from edge.geometry import se3, so3
from edge.lines.guided import localise
from edge.lines.line import Lines, Segments, lines_between, segments_between
from edge.types import F64, Mat4
from tests.edge.lines.line_scenes import CAMERA, ends_before, project, viewpoint

NOISE_PX = 0.3


def seen(rng: np.random.Generator, T: Mat4, pairs: F64) -> Segments:
    """Parts of all lines, in another order each time, the brighter side on the same hand."""
    share = np.array([rng.uniform(0.0, 0.1), rng.uniform(0.9, 1.0)])[:, None]
    parts = pairs[:, :1] + share * (pairs[:, 1:] - pairs[:, :1])
    pixels = project(se3.transform(T, parts.reshape(-1, 3))).reshape(-1, 4)
    order = rng.permutation(len(pairs))
    return segments_between(pixels[order] + rng.normal(0, NOISE_PX, pixels.shape), NOISE_PX)


def known(pairs: F64) -> tuple[Lines, F64]:
    """The lines, and their spans."""
    half = 0.5 * np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=1)
    return lines_between(pairs[:, 0], pairs[:, 1], 1e-3), np.column_stack((-half, half))


def drive(seed: int, n_images: int) -> tuple[F64, F64, np.random.Generator]:
    """Poses (n, 4, 4) some centimetres and a degree apart, and lines in view of all."""
    rng = np.random.default_rng(seed)
    T = viewpoint(rng)
    poses = [
        se3.exp([0.02 * k, 0.01 * k, 0, 0, 0.02 * np.sin(k), 0.01]) @ T for k in range(n_images)
    ]
    return np.array(poses), ends_before(rng, T, 30, flat=False), rng


def test_lines_alone_follow_a_camera_from_prediction_to_prediction() -> None:
    poses, pairs, rng = drive(1, 24)
    lines, span = known(pairs)
    T_guess, config = poses[0], PairingConfig()
    for T in poses:
        here = localise(lines, span, seen(rng, T, pairs), CAMERA, T_guess, config)
        assert here is not None
        T_guess = here.pose.T_cam_lines
        off = T_guess @ se3.inverse(T)
        assert so3.angle(off[:3, :3]) < 0.02
        assert np.linalg.norm(se3.inverse(T_guess)[:3, 3] - se3.inverse(T)[:3, 3]) < 0.06
        assert np.count_nonzero(here.agree) >= 8


def test_too_few_lines_give_no_pose() -> None:
    poses, pairs, rng = drive(1, 12)
    lines, span = known(pairs)
    segments = seen(rng, poses[0], pairs[:3])
    config = PairingConfig()
    assert localise(lines, span, segments, CAMERA, poses[0], config) is None


def test_a_pose_that_most_pairs_contradict_is_not_given() -> None:
    poses, pairs, rng = drive(1, 24)
    lines, span = known(pairs)
    segments = seen(rng, poses[0], pairs)
    shifted = rng.uniform(-9.0, 9.0, segments.middle.shape)
    wrong = segments._replace(middle=segments.middle + shifted)
    config = PairingConfig()
    assert localise(lines, span, wrong, CAMERA, poses[0], config) is None
    assert localise(lines, span, segments, CAMERA, poses[0], config) is not None
