# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.image.pyramid import Pyramid
from edge.odometry import kernels_epipolar as kep
from edge.odometry import kernels_trace as ktr
from edge.odometry import kernels_window as kw
from edge.odometry.candidates import CandidateSelector, refine, trace_all
from edge.odometry.window import Window
from edge.types import F32, F64, Frame, Mat4
from tests.edge.odometry.built_window import build_window, margin_mask
from tests.edge.odometry.scenes import MIDDLE, Corner, level_of, to_bytes

CONFIG = OdometryConfig().resolved()
SEARCH_PX = 20.0
START = se3.exp([-0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
MOTIONS = {
    "sideways": [0.025, 0.004, 0.0, 0.0, -0.004, 0.002],
    "up": [0.002, -0.025, 0.002, 0.0, 0.0, 0.0],
    "forward": [0.0, 0.002, 0.05, 0.0, 0.0, 0.004],
    "backward": [0.0, 0.0, -0.05, 0.002, 0.0, 0.0],
}


def image_at(corner: Corner, T_world_cam: Mat4, seed: int, affine: tuple[float, float]) -> F64:
    """Image with the noise and the rounding of a camera."""
    grey = np.exp(affine[0]) * corner.image(MIDDLE, T_world_cam) + affine[1]
    return to_bytes(grey, 1.0, seed).astype(np.float64)


def keyframe_window(corner: Corner, affine: tuple[float, float] = (0.0, 0.0)) -> Window:
    """A window of one keyframe with fresh candidates."""
    window = Window(MIDDLE.pinhole, margin_mask(), CONFIG)
    level = level_of(image_at(corner, START, 0, affine))
    nothing = Frame(0, 0, np.zeros((2, 2), np.uint8))
    keyframe = window.add_keyframe(nothing, Pyramid((level,)), se3.inverse(START), np.array(affine))
    keyframe.candidates = CandidateSelector(window.mask, CONFIG).select(level, 400, 0)
    return window


def truth_of(corner: Corner, table: F32) -> F64:
    return 1.0 / corner.depth_at(MIDDLE, START, *table[:2].astype(np.float64))


def drive(
    corner: Corner, window: Window, motion: list[float], steps: int, gain: float = 0.0
) -> list[F32]:
    """Trace over frames of a steady motion; the table after each."""
    T, tables = START, []
    for n in range(steps):
        T = T @ se3.exp(motion)
        affine = (gain * (n + 1), -2.0 * gain * n)
        level = level_of(image_at(corner, T, n + 1, affine))
        trace_all(window, level, se3.inverse(T), np.array(affine), SEARCH_PX)
        tables.append(window.keyframes[0].candidates.copy())
    return tables


def holds(table: F32, truth: F64, slack: float = 0.0) -> np.ndarray:
    """Whether each interval, widened by a share of itself, contains the truth."""
    extra = slack * (table[ktr.HIGH] - table[ktr.LOW])
    return (table[ktr.LOW] - extra <= truth) & (truth <= table[ktr.HIGH] + extra)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_intervals_contain_the_truth_and_shrink(motion: list[float]) -> None:
    corner = Corner(1)
    window = keyframe_window(corner)
    truth = truth_of(corner, window.keyframes[0].candidates)
    tables = drive(corner, window, motion, 8)
    found = [table[ktr.STATUS] == kep.GOOD for table in tables]
    assert np.count_nonzero(found[-1]) > (100 if motion[2] else 150)
    last, good = tables[-1], found[-1]
    assert np.mean(holds(last, truth)[good]) > 0.75
    assert np.mean(holds(last, truth, slack=0.5)[good]) > 0.9
    assert np.median(last[ktr.INTERVAL_PX][good]) < 4.0
    middle = 0.5 * (last[ktr.LOW] + last[ktr.HIGH])
    assert np.median(np.abs(middle / truth - 1.0)[good]) < (0.02 if motion[2] else 0.01)

    def width(table: F32, good: np.ndarray) -> float:
        return float(np.median((table[ktr.HIGH] - table[ktr.LOW])[good]))

    assert width(last, found[1] & good) < 0.7 * width(tables[1], found[1] & good)


def test_brightness_is_taken_off_before_comparing() -> None:
    corner = Corner(2, mean_grey=90.0, contrast_grey=22.0)
    window = keyframe_window(corner, affine=(-0.1, 30.0))
    truth = truth_of(corner, window.keyframes[0].candidates)
    last = drive(corner, window, MOTIONS["sideways"], 6, gain=0.08)[-1]
    good = last[ktr.STATUS] == kep.GOOD
    assert np.count_nonzero(good) > 140
    assert np.mean(holds(last, truth, slack=0.5)[good]) > 0.9


def test_without_translation_nothing_is_learnt() -> None:
    corner = Corner(3)
    window = keyframe_window(corner)
    last = drive(corner, window, [0, 0, 0, 0.0, 0.01, 0.0], 3)[-1]
    assert np.count_nonzero(last[ktr.STATUS] == kep.GOOD) == 0
    assert np.all(np.isnan(last[ktr.HIGH]))


def test_matches_in_another_image_are_not_unique() -> None:
    corner = Corner(4)
    T = START @ se3.exp(MOTIONS["sideways"])
    unique = []
    for shown in (corner, Corner(44)):
        window = keyframe_window(corner)
        level = level_of(image_at(shown, T, 1, (0.0, 0.0)))
        good = trace_all(window, level, se3.inverse(T), np.zeros(2), SEARCH_PX)
        table = window.keyframes[0].candidates
        matched = table[ktr.STATUS] == kep.GOOD
        assert good == np.count_nonzero(matched)
        unique.append(np.mean(matched & (table[ktr.QUALITY] > CONFIG.min_uniqueness)))
    assert unique[0] > 0.6
    assert unique[1] < 0.2


def test_points_that_left_the_image_stay_out() -> None:
    corner = Corner(5)
    window = keyframe_window(corner)
    there = drive(corner, window, [0.02, 0.0, 0.0, 0.0, 0.25, 0.0], 2)
    out = [table[ktr.STATUS] == kep.OUT for table in there]
    assert np.count_nonzero(out[0]) > 50
    assert np.count_nonzero(out[1]) > np.count_nonzero(out[0])
    assert np.all(out[1][out[0]])
    back = drive(corner, window, MOTIONS["sideways"], 1)[-1]
    assert np.all((back[ktr.STATUS] == kep.OUT)[out[1]])


def test_description_is_of_the_host_image() -> None:
    level = level_of(Corner(6).image(MIDDLE, START))
    table = np.zeros((ktr.CANDIDATE_ROWS, 2), np.float32)
    table[:2] = [[50, 100], [60, 70]]
    ktr.describe(level, np.float32(50.0), np.float32(12.0), table)
    for i, (u, v) in enumerate(((50, 60), (100, 70))):
        pixels = level[(v + kw.PATTERN_V).astype(int), (u + kw.PATTERN_U).astype(int)]
        assert np.array_equal(table[kw.GREY : kw.GREY + 8, i], pixels[:, 0])
        slope2 = (pixels[:, 1:] ** 2).sum(axis=1)
        weight = np.sqrt(2500.0 / (2500.0 + slope2))
        np.testing.assert_allclose(table[kw.WEIGHT : kw.WEIGHT + 8, i], weight, rtol=1e-5)
        tensor = pixels[:, 1:].T @ pixels[:, 1:]
        np.testing.assert_allclose(
            table[[ktr.GXX, ktr.GXY, ktr.GYY], i],
            tensor[[0, 0, 1], [0, 1, 1]],
            rtol=1e-4,
            atol=1e-2,
        )
    assert np.all(table[ktr.LIMIT] == 8 * 12.0**2)
    assert np.all(np.isnan(table[ktr.HIGH]))


def candidates_for(corner: Corner, window: Window, width: float) -> tuple[F32, F64]:
    """Candidates of the first keyframe whose intervals miss the truth by up to half a width."""
    table = CandidateSelector(window.mask, CONFIG).select(window.images[0], 200, 1)
    depth = corner.depth_at(MIDDLE, window.keyframes[0].T_odom_cam, *table[:2].astype(np.float64))
    rng = np.random.default_rng(0)
    middle = 1.0 / depth * (1.0 + rng.uniform(-0.5, 0.5, len(depth)) * width)
    table[ktr.LOW], table[ktr.HIGH] = middle * (1 - width / 2), middle * (1 + width / 2)
    return table, 1.0 / depth


@pytest.mark.parametrize("affine", [(0.0, 0.0), (0.15, 25.0)], ids=["same light", "other light"])
def test_refinement_finds_the_depths(affine: tuple[float, float]) -> None:
    corner = Corner(7, mean_grey=90.0, contrast_grey=25.0)
    window = build_window(corner, brightness=[affine, (0, 0), (0.1, -8), (0, 12), (-0.1, 0)])
    table, truth = candidates_for(corner, window, 0.2)
    before = np.abs(0.5 * (table[ktr.LOW] + table[ktr.HIGH]) / truth - 1.0)
    ok, good = refine(window, table, np.zeros(table.shape[1], np.int32))
    error = np.abs(table[kw.IDEPTH] / truth - 1.0)[ok]
    assert np.mean(ok) > 0.6
    assert np.median(error) < 0.02
    assert np.median(before) > 0.03
    assert not np.any(good[0])  # none in its own host
    assert np.all(good[1:, ok].sum(axis=0) >= 1)
    assert np.array_equal(table[kw.GOOD_VIEWS], good.sum(axis=0))


def test_depths_that_fit_nowhere_are_refused() -> None:
    corner = Corner(8)
    window = build_window(corner)
    table, _ = candidates_for(corner, window, 0.1)
    table[kw.GREY : kw.GREY + 8] = 255.0 - table[kw.GREY : kw.GREY + 8]
    ok, _ = refine(window, table, np.zeros(table.shape[1], np.int32))
    assert np.mean(ok) < 0.2


def test_candidates_seen_by_nobody_are_refused() -> None:
    window = build_window(Corner(9))
    table, _ = candidates_for(Corner(9), window, 0.1)
    for keyframe in window.keyframes[1:]:
        keyframe.T_first = se3.exp([0, 0, 0, 0, 1.5, 0]) @ keyframe.T_first
    ok, good = refine(window, table, np.zeros(table.shape[1], np.int32))
    assert not np.any(ok)
    assert not np.any(good)
