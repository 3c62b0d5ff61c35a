# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np

from edge.odometry.line_start import segment_detector
from edge.odometry.line_trail import LineTrail
from edge.types import U8, Frame, Pinhole

CAMERA = Pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
MASK = np.ones((240, 320), np.uint8)
STEP_PX = 5


def wall(shift_px: int) -> U8:
    """Part of a long wall with boards, none like the next."""
    rng = np.random.default_rng(5)
    image = np.full((240, 320), 70, np.uint8)
    for column in range(12):
        for row in range(2):
            corner = np.array([70 * column + 10 - shift_px, 110 * row + 15])
            board = np.array([[0, 0], [50, 0], [50, 80], [0, 80]]) + rng.integers(-6, 7, (4, 2))
            cv2.fillPoly(image, [(corner + board).astype(np.int32)], int(rng.integers(140, 240)))
    return image


def played(n: int) -> LineTrail:
    trail, detector = LineTrail(560, MASK), segment_detector(CAMERA)
    for k in range(n):
        image = wall(k * STEP_PX)
        trail.step(Frame(k, k, image), image, detector.detect(image, MASK))
    return trail


def test_edges_and_corners_are_followed_to_where_they_went() -> None:
    trail = played(4)
    first, last = trail.sightings[0], trail.sightings[-1]
    assert first.frame.index == 0
    moved = last.corners - first.corners
    moved = moved[np.isfinite(moved[:, 0])]
    assert len(moved) > 20
    np.testing.assert_allclose(np.median(moved, axis=0), [-3 * STEP_PX, 0], atol=0.3)
    ends = last.segments - first.segments
    upright = np.abs(last.segments[:, 2] - last.segments[:, 0]) < 15
    across = ends[upright & np.isfinite(ends[:, 0])]
    assert len(across) >= 9
    np.testing.assert_allclose(np.median(across[:, [0, 2]]), -3 * STEP_PX, atol=0.5)


def test_the_first_frame_moves_up_when_what_it_shows_has_left() -> None:
    trail = played(60)
    first, last = trail.sightings[0], trail.sightings[-1]
    assert 0 < first.frame.index < last.frame.index - 3
    assert last.frame.index == 59
    assert trail.has_enough
    for sighting in trail.sightings:
        assert len(sighting.corners) == len(last.corners)
        assert np.isfinite(sighting.segments[:, 0]).sum() >= 9


def test_no_frame_is_older_than_asked() -> None:
    trail = played(6)
    trail.forget_older(3)
    assert [s.frame.index for s in trail.sightings] == [2, 3, 4, 5]
