# SPDX-License-Identifier: Apache-2.0
import itertools

import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.image.pyramid import Pyramid, PyramidBuilder
from edge.odometry.reference import Reference, make_reference
from edge.odometry.tracker import MAX_LOG_GAIN, Tracked, Tracker, motion_guesses
from edge.types import F64, Mat4
from tests.edge.odometry.scenes import MIDDLE, Corner, to_bytes

CONFIG = OdometryConfig().resolved()
T_WORLD_REFERENCE = se3.exp([-0.05, 0.02, 0.0, 0.0, 0.03, 0.0])
EXPECTED_RESIDUAL = 5.0


def builder() -> PyramidBuilder:
    return PyramidBuilder(MIDDLE, 0, 4, 8)


def reference_of(
    corner: Corner, frames: PyramidBuilder, affine: tuple[float, float] = (0.0, 0.0)
) -> Reference:
    """A keyframe with the true depths of pixels spread all over it."""
    grey = np.exp(affine[0]) * corner.image(MIDDLE, T_WORLD_REFERENCE) + affine[1]
    v, u = np.mgrid[6:174:5, 6:234:5].reshape(2, -1).astype(np.float64)
    depth = corner.depth_at(MIDDLE, T_WORLD_REFERENCE, u, v)
    projected = np.stack((u, v, 1.0 / depth)).astype(np.float32)
    return make_reference(
        0,
        T_WORLD_REFERENCE,
        np.array(affine),
        frames.build(to_bytes(grey, 1.0)),
        frames.masks,
        frames.pinholes,
        projected,
        np.ones(len(u), np.float32),
    )


def image_from(
    corner: Corner, frames: PyramidBuilder, motion: F64, gain: float = 1.0, offset: float = 0.0
) -> Pyramid:
    """What is seen after `motion`, T_cam_reference."""
    T_world_cam = T_WORLD_REFERENCE @ se3.inverse(se3.exp(motion))
    grey = gain * corner.image(MIDDLE, T_world_cam) + offset
    return frames.build(to_bytes(grey, 1.0, seed=1))


def track(
    frames: PyramidBuilder,
    pyramid: Pyramid,
    reference: Reference,
    *guesses: Mat4,
    affine: tuple[float, float] = (0.0, 0.0),
) -> Tracked:
    tracker = Tracker(frames.pinholes, frames.masks, CONFIG)
    return tracker.track(pyramid, reference, iter(guesses), np.array(affine), EXPECTED_RESIDUAL)


def apart(tracked: Tracked, motion: F64) -> tuple[float, float]:
    """How far off: translation, rotation [rad]."""
    xi = se3.log(tracked.T_cam_reference @ se3.inverse(se3.exp(motion)))
    return float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:]))


MOTIONS = {
    "still": [0, 0, 0, 0, 0, 0],
    "sideways 10 px": [0.12, 0.0, 0.0, 0.0, 0.0, 0.0],
    "forward": [0.0, 0.0, -0.2, 0.0, 0.0, 0.0],
    "turn 10 px": [0.0, 0.0, 0.0, 0.0, 0.05, 0.0],
    "roll": [0.0, 0.0, 0.0, 0.0, 0.0, 0.08],
    "all": [0.06, -0.03, -0.08, 0.02, 0.03, -0.03],
}


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_a_motion_is_found_from_standing_still(motion: list[float]) -> None:
    corner, frames = Corner(1), builder()
    reference = reference_of(corner, frames)
    xi = np.array(motion, np.float64)
    tracked = track(frames, image_from(corner, frames, xi), reference, np.eye(4))
    shift, turn = apart(tracked, xi)
    assert shift < 3e-3  # of 2.5: a quarter of a pixel
    assert turn < 1e-3
    assert tracked.inlier_share > 0.8
    assert tracked.residual_grey < 6.0


def test_darker_and_brighter_images_are_explained() -> None:
    corner, frames = Corner(2, mean_grey=90.0, contrast_grey=24.0), builder()
    reference = reference_of(corner, frames, affine=(0.1, -3.0))
    xi = np.array(MOTIONS["all"])
    gain, offset = np.exp(0.3 + 0.1), 10.0
    tracked = track(
        frames, image_from(corner, frames, xi, gain, offset), reference, np.eye(4), affine=(0.1, -3)
    )
    shift, turn = apart(tracked, xi)
    assert shift < 3e-3
    assert turn < 1e-3
    a, b = tracked.affine
    assert a == pytest.approx(0.4, abs=0.02)
    # a and b stand for one another about the mean grey: what counts is what they do there.
    assert np.exp(a) * 90.0 + b == pytest.approx(gain * 90.0 + offset, abs=1.0)


@pytest.mark.parametrize(
    ("gain", "offset"), [(0.25, 5.0), (0.25, 100.0), (1.5, -60.0), (2.5, -120.0), (1.0, 100.0)]
)
def test_a_light_that_is_switched_is_found_at_once(gain: float, offset: float) -> None:
    corner, frames = Corner(3, mean_grey=90.0, contrast_grey=24.0), builder()
    reference = reference_of(corner, frames)
    xi = np.array([0.06, 0.02, 0.05, 0.02, 0.03, 0.02])
    pyramid = image_from(corner, frames, xi, gain, offset)
    tracked = track(frames, pyramid, reference, np.eye(4))
    shift, turn = apart(tracked, xi)
    assert shift < 3e-3
    assert turn < 1e-3
    assert tracked.affine[0] == pytest.approx(np.log(gain), abs=0.05)
    assert tracked.inlier_share > 0.8


def test_later_guesses_are_tried_only_while_the_result_is_poor() -> None:
    corner, frames = Corner(4), builder()
    reference = reference_of(corner, frames)
    xi = np.array([0.0, 0.0, 0.0, 0.0, 0.35, 0.0])  # a third of the image
    pyramid = image_from(corner, frames, xi)
    poor = track(frames, pyramid, reference, np.eye(4))
    assert apart(poor, xi)[1] > 0.05
    assert poor.residual_grey > 1.5 * EXPECTED_RESIDUAL
    assert poor.strays
    near = se3.exp([0.0, 0.0, 0.0, 0.0, 0.33, 0.0])
    found = track(frames, pyramid, reference, np.eye(4), np.eye(4), near)
    assert apart(found, xi)[1] < 2e-3
    assert not found.strays  # most points agree, far as it is
    asked = itertools.count()
    good = (near for _ in iter(lambda: next(asked), 20))
    Tracker(frames.pinholes, frames.masks, CONFIG).track(
        pyramid, reference, good, np.zeros(2), EXPECTED_RESIDUAL
    )
    assert next(asked) == 1


def test_another_place_is_not_believed() -> None:
    frames = builder()
    reference = reference_of(Corner(5), frames)
    elsewhere = image_from(Corner(6), frames, np.zeros(6))
    guesses = motion_guesses(np.eye(4), np.eye(4))
    tracked = track(frames, elsewhere, reference, *guesses)
    # What is not there can only be explained away by a gain near zero.
    assert tracked.inlier_share < CONFIG.min_inlier_share or tracked.affine[0] < -MAX_LOG_GAIN


def test_information_predicts_the_scatter_of_poses() -> None:
    corner, frames = Corner(7), builder()
    reference = reference_of(corner, frames)
    xi = np.array([0.03, 0.0, -0.02, 0.01, 0.0, 0.01])
    T_world_cam = T_WORLD_REFERENCE @ se3.inverse(se3.exp(xi))
    grey, found = corner.image(MIDDLE, T_world_cam), []
    for seed in range(20):
        pyramid = frames.build(to_bytes(grey, 4.0, seed=100 + seed))
        tracked = track(frames, pyramid, reference, se3.exp(xi))
        found.append(se3.log(tracked.T_cam_reference @ se3.inverse(se3.exp(xi))))
    scatter = np.std(found, axis=0)
    claimed = np.sqrt(np.diag(np.linalg.inv(tracked.information))) * tracked.residual_grey
    ratio = scatter / claimed
    # Neighbouring tracking points share pixels: they say less than their number.
    assert np.all(ratio < 4.0)
    assert np.all(ratio > 0.15)


def test_flow_tells_parallax_from_rotation() -> None:
    corner, frames = Corner(8), builder()
    reference = reference_of(corner, frames)
    turn = np.array([0.0, 0.0, 0.0, 0.0, 0.05, 0.0])
    whole, shift, rotation = track(
        frames, image_from(corner, frames, turn), reference, np.eye(4)
    ).flow_px2
    assert np.sqrt(whole) == pytest.approx(0.05 * MIDDLE.fx, rel=0.15)
    assert np.sqrt(rotation) == pytest.approx(np.sqrt(whole), rel=0.05)
    assert np.sqrt(shift) < 0.5


def test_guesses_begin_with_constant_motion_and_stay_rigid() -> None:
    T_reference, T_last = se3.exp([0.1, 0, 0, 0, 0.1, 0]), se3.exp([0.02, 0, 0, 0.01, 0, 0])
    guesses = list(motion_guesses(T_reference, T_last))
    np.testing.assert_allclose(guesses[0], T_last @ T_reference)
    assert any(np.allclose(T, T_reference) for T in guesses)
    assert any(np.allclose(T, np.eye(4)) for T in guesses)
    for T in guesses:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
