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


def played(n: int, max_age: int = 150) -> LineTrail:
    trail, detector = LineTrail(), segment_detector(CAMERA)
    for k in range(n):
        image = wall(k * STEP_PX)
        trail.step(Frame(k, k, image), detector.detect(image, MASK), max_age)
    return trail


def test_edges_are_followed_to_where_they_went() -> None:
    trail = played(4)
    first, last = trail.sightings[0], trail.sightings[-1]
    assert first.frame.index == 0
    ends = last.segments - first.segments
    upright = np.abs(last.segments[:, 2] - last.segments[:, 0]) < 15
    across = ends[upright & np.isfinite(ends[:, 0])]
    assert len(across) >= 9
    np.testing.assert_allclose(np.median(across[:, [0, 2]]), -3 * STEP_PX, atol=0.5)


def test_the_first_frame_moves_up_when_what_it_shows_has_left() -> None:
    trail = played(80)
    first, last = trail.sightings[0], trail.sightings[-1]
    assert 0 < first.frame.index < last.frame.index - 3
    assert last.frame.index == 79
    assert trail.has_enough
    between = trail.sightings[trail.reference]
    assert first.frame.index < between.frame.index < last.frame.index
    for end in (first, last):
        both = np.isfinite(end.segments[:, 0]) & np.isfinite(between.segments[:, 0])
        assert both.sum() >= 9


def test_one_between_lets_the_trail_reach_further_than_its_ends_share() -> None:
    trail = played(60)
    first, last = trail.sightings[0], trail.sightings[-1]
    assert first.frame.index == 0
    assert (
        np.count_nonzero(np.isfinite(first.segments[:, 0]) & np.isfinite(last.segments[:, 0])) < 9
    )


def test_no_frame_is_older_than_asked() -> None:
    trail = played(6, max_age=3)
    assert [s.frame.index for s in trail.sightings] == [2, 3, 4, 5]
