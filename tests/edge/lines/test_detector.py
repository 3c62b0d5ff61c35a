# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.config.lines import SegmentConfig
from edge.lines.detector import SegmentDetector
from edge.lines.line import Segments, ends
from edge.types import F64, U8

CONFIG = SegmentConfig()
NOISE_GREY = 3.0


def strip(
    shape: tuple[int, int], start: F64, angle_rad: float, length: float, width: float
) -> tuple[U8, F64]:
    """A bright strip on dark ground (exact but for its blur), and its long edge's ends (4,)."""
    along = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    s = (u - start[0]) * along[0] + (v - start[1]) * along[1]
    w = -(u - start[0]) * along[1] + (v - start[1]) * along[0]
    share = np.ones(shape)
    for distance in (s, length - s, w, width - w):
        share *= 1.0 / (1.0 + np.exp(-distance / 0.4))
    noise = np.random.default_rng(5).normal(0.0, NOISE_GREY, shape)
    image = np.clip(60.0 + 120.0 * share + noise, 0, 255).astype(np.uint8)
    return image, np.r_[start, start + length * along]


def off_line_px(segments: Segments, k: int, truth: F64) -> F64:
    """Distances (2,) of a segment's ends from the line through `truth` (4,)."""
    along = (truth[2:] - truth[:2]) / np.linalg.norm(truth[2:] - truth[:2])
    away = ends(segments)[k].reshape(2, 2) - truth[:2]
    return np.asarray(away @ [-along[1], along[0]])


def nearest(segments: Segments, truth: F64) -> int:
    away = [np.abs(off_line_px(segments, k, truth)).max() for k in range(len(segments.length))]
    return int(np.argmin(away))


@pytest.mark.parametrize("angle_deg", [0.0, 7.0, 45.0, 90.0, 133.0])
@pytest.mark.parametrize("shape", [(240, 320), (241, 321)], ids=["even", "odd"])
def test_edges_are_found_where_they_are(angle_deg: float, shape: tuple[int, int]) -> None:
    angle = np.deg2rad(angle_deg)
    start = np.array([160.3, 120.7]) - 60.0 * np.array([np.cos(angle), np.sin(angle)])
    image, truth = strip(shape, start, angle, 120.0, 30.0)
    segments = SegmentDetector(CONFIG).detect(image)
    k = nearest(segments, truth)
    assert np.all(np.abs(off_line_px(segments, k, truth)) < 0.2)
    assert np.all(np.abs(off_line_px(segments, k, truth)) < 4.0 * segments.sigma[k])
    assert segments.length[k] == pytest.approx(120.0, abs=8.0)


def test_errors_are_as_large_as_told() -> None:
    errors = []
    rng = np.random.default_rng(3)
    for _ in range(25):
        start = rng.uniform([60.0, 60.0], [120.0, 120.0])
        image, truth = strip((240, 320), start, rng.uniform(0.0, 0.7), 110.0, 25.0)
        segments = SegmentDetector(CONFIG).detect(image)
        k = nearest(segments, truth)
        errors += list(off_line_px(segments, k, truth) / segments.sigma[k])
    assert 0.1 < np.sqrt(np.mean(np.square(errors))) < 1.2


def test_pieces_of_one_edge_are_joined() -> None:
    image, truth = strip((240, 320), np.array([40.0, 80.0]), 0.2, 220.0, 40.0)
    for u in (110, 180):  # a post before it
        image[:, u : u + 12] = 60
    segments = SegmentDetector(CONFIG).detect(image)
    k = nearest(segments, truth)
    assert segments.length[k] == pytest.approx(220.0, abs=10.0)
    assert np.all(np.abs(off_line_px(segments, k, truth)) < 0.3)


def test_both_edges_of_a_thin_batten_stay_apart() -> None:
    image, _ = strip((240, 320), np.array([60.0, 100.0]), 0.0, 200.0, 6.0)
    segments = SegmentDetector(CONFIG).detect(image)
    long = segments.length > 150.0
    assert sorted(np.round(segments.middle[long, 1])) == [100.0, 106.0]
    # The brighter side is on the same hand of both, so they run in opposite directions.
    assert np.prod(segments.direction[long, 0]) < -0.9


def test_short_faint_and_invalid_ones_are_left_out() -> None:
    detector = SegmentDetector(CONFIG)
    blank = np.full((240, 320), 90, np.uint8)
    assert len(detector.detect(blank).length) == 0
    short, _ = strip((240, 320), np.array([100.0, 100.0]), 0.3, 18.0, 15.0)
    assert len(detector.detect(short).length) == 0
    image, truth = strip((240, 320), np.array([60.0, 80.0]), 0.1, 200.0, 40.0)
    valid = np.ones(image.shape, np.uint8)
    valid[:110] = 0
    kept = detector.detect(image, valid)
    assert len(kept.length) >= 1
    assert np.all(kept.middle[:, 1] > 110.0)
    assert np.all(np.abs(off_line_px(kept, nearest(kept, truth), truth)) > 30.0)


def test_no_more_than_the_longest_are_given_and_twice_the_same() -> None:
    rng = np.random.default_rng(8)
    image = np.zeros((240, 320), np.uint8)
    for _ in range(60):
        u, v = rng.integers(10, 270), rng.integers(10, 190)
        image[v : v + rng.integers(10, 50), u : u + rng.integers(20, 50)] = rng.integers(0, 255)
    few = SegmentDetector(SegmentConfig(max_segments=5)).detect(image)
    assert len(few.length) == 5
    detector = SegmentDetector(CONFIG)
    first, second = detector.detect(image), detector.detect(image)
    assert len(first.length) > 5
    assert np.all(np.diff(first.length) <= 0.0)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def test_two_edges_joined_into_one_are_as_uncertain_as_they_are_apart() -> None:
    told = []
    for step_px in (0.0, 1.2):
        image, truth = strip((240, 320), np.array([40.0, 80.0]), 0.1, 120.0, 40.0)
        other, _ = strip((240, 320), np.array([40.0, 80.0 + step_px]), 0.1, 240.0, 40.0)
        image[:, 160:] = other[:, 160:]
        segments = SegmentDetector(SegmentConfig(floor_px=1e-3)).detect(image)
        k = nearest(segments, truth)
        assert segments.length[k] > 200.0  # both halves
        told.append(segments.sigma[k])
    assert told[0] < 0.06
    assert told[1] > 5.0 * told[0]
