# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.config.lines import PairingConfig, SegmentTracksConfig
from edge.geometry import se3, so3
from edge.lines.guided import localise
from edge.lines.line import Segments, segments_between
from edge.lines.tracks import SegmentTracks
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


def drive(seed: int, n_images: int) -> tuple[F64, F64, np.random.Generator]:
    """Poses (n, 4, 4) some centimetres and a degree apart, and lines in view of all."""
    rng = np.random.default_rng(seed)
    T = viewpoint(rng)
    poses = [
        se3.exp([0.02 * k, 0.01 * k, 0, 0, 0.02 * np.sin(k), 0.01]) @ T for k in range(n_images)
    ]
    return np.array(poses), ends_before(rng, T, 30, flat=False), rng


def test_followed_segments_tell_the_lines_that_they_show() -> None:
    known, right = 0, 0
    for seed in range(4):
        poses, pairs, rng = drive(seed, 20)
        tracks = SegmentTracks(CAMERA, SegmentTracksConfig())
        for T in poses:
            tracks.step(seen(rng, T, pairs), T)
        found = tracks.structure()
        true = pairs[:, 1] - pairs[:, 0]
        true /= np.linalg.norm(true, axis=1, keepdims=True)
        cosine = np.abs(found.lines.direction @ true.T)
        away = found.lines.point[:, None] - pairs[None, :, 0]
        off = np.linalg.norm(np.cross(away, true[None]), axis=2)
        sigma = np.sqrt(np.linalg.eigvalsh(found.lines.covariance)[:, -1])
        near = (np.arccos(np.minimum(cosine, 1.0)) < 5.0 * sigma[:, None] + 1e-3) & (
            off < 5.0 * sigma[:, None] + 1e-3
        )
        known += len(found.span)
        right += np.count_nonzero(near.any(axis=1))
    assert known >= 24
    assert right >= 0.95 * known


def test_a_turn_of_the_camera_alone_breaks_no_track_and_tells_no_line() -> None:
    rng = np.random.default_rng(4)
    T = viewpoint(rng)
    pairs = ends_before(rng, T, 10, flat=False)
    tracks = SegmentTracks(CAMERA, SegmentTracksConfig())
    for k in range(6):
        turned = se3.exp([0, 0, 0, 0, 0.04 * k, 0.02 * k]) @ T
        tracks.step(seen(rng, turned, pairs), turned)
    lengths = [len(views.segments.length) for views in tracks.views()]
    assert sorted(lengths)[-8:] == [6] * 8
    assert len(tracks.structure().span) == 0


def test_lines_alone_follow_a_camera_from_prediction_to_prediction() -> None:
    poses, pairs, rng = drive(1, 24)
    tracks = SegmentTracks(CAMERA, SegmentTracksConfig())
    for T in poses:
        tracks.step(seen(rng, T, pairs), T)
    found = tracks.structure()
    T_guess, config = poses[0], PairingConfig()
    for T in poses:
        here = localise(found.lines, found.span, seen(rng, T, pairs), CAMERA, T_guess, config)
        assert here is not None
        T_guess = here.pose.T_cam_lines
        off = T_guess @ se3.inverse(T)
        assert so3.angle(off[:3, :3]) < 0.02
        assert np.linalg.norm(se3.inverse(T_guess)[:3, 3] - se3.inverse(T)[:3, 3]) < 0.06
        assert np.count_nonzero(here.agree) >= 8


def test_too_few_lines_give_no_pose() -> None:
    poses, pairs, rng = drive(1, 12)
    tracks = SegmentTracks(CAMERA, SegmentTracksConfig())
    for T in poses:
        tracks.step(seen(rng, T, pairs), T)
    found = tracks.structure()
    segments = seen(rng, poses[0], pairs[:3])
    config = PairingConfig()
    assert localise(found.lines, found.span, segments, CAMERA, poses[0], config) is None


def test_a_pose_that_most_pairs_contradict_is_not_given() -> None:
    poses, pairs, rng = drive(1, 24)
    tracks = SegmentTracks(CAMERA, SegmentTracksConfig())
    for T in poses:
        tracks.step(seen(rng, T, pairs), T)
    found = tracks.structure()
    segments = seen(rng, poses[0], pairs)
    shifted = rng.uniform(-9.0, 9.0, segments.middle.shape)
    wrong = segments._replace(middle=segments.middle + shifted)
    config = PairingConfig()
    assert localise(found.lines, found.span, wrong, CAMERA, poses[0], config) is None
    assert localise(found.lines, found.span, segments, CAMERA, poses[0], config) is not None
