# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.image.pyramid import Pyramid
from edge.odometry import candidates as cand
from edge.odometry import kernels_epipolar as kep
from edge.odometry import kernels_trace as ktr
from edge.odometry import kernels_window as kw
from edge.odometry.window import Window
from edge.types import Frame
from tests.edge.odometry.built_window import build_window, margin_mask
from tests.edge.odometry.scenes import MIDDLE, Corner, level_of

CONFIG = OdometryConfig().resolved()
NOBODY = np.zeros((3, 0), np.float32)


@pytest.mark.parametrize("wanted", [100, 400, 800])
def test_about_the_wanted_number_is_selected_and_spread(wanted: int) -> None:
    level = level_of(Corner(0).image(MIDDLE, np.eye(4)))
    selector = cand.CandidateSelector(margin_mask(), CONFIG)
    for _ in range(2):  # the spacing adapts
        table = selector.select(level, wanted, 3)
    assert 0.75 * wanted < table.shape[1] <= wanted
    cells = (table[kw.V] // 45).astype(int) * 6 + (table[kw.U] // 40).astype(int)
    counts = np.bincount(cells, minlength=24)
    assert np.mean(counts > 0.15 * counts.mean()) > 0.9
    # Strong gradients are preferred.
    slope = np.hypot(level[..., 1], level[..., 2])
    chosen = slope[table[kw.V].astype(int), table[kw.U].astype(int)]
    assert np.median(chosen) > 1.4 * np.median(slope)


def test_selection_repeats() -> None:
    level = level_of(Corner(1).image(MIDDLE, np.eye(4)))
    first = cand.CandidateSelector(margin_mask(), CONFIG).select(level, 200, 5)
    again = cand.CandidateSelector(margin_mask(), CONFIG).select(level, 200, 5)
    assert first.tobytes() == again.tobytes()


def test_a_blank_image_has_no_candidates() -> None:
    blank = np.zeros((MIDDLE.height, MIDDLE.width, 3), np.float32)
    table = cand.CandidateSelector(margin_mask(), CONFIG).select(blank, 200, 0)
    assert table.shape == (ktr.CANDIDATE_ROWS, 0)


def test_the_distance_follows_the_number_of_points() -> None:
    assert cand.spread_distance(2.0, 400, 800) < 2.0
    assert cand.spread_distance(2.0, 1200, 800) > 2.0
    assert cand.spread_distance(2.0, 800, 800) == 2.0
    assert cand.spread_distance(0.1, 0, 800) == 0.0
    assert cand.spread_distance(4.0, 8000, 800) == cand.MAX_DISTANCE_PX


def ready_window(seed: int = 2) -> tuple[Window, np.ndarray]:
    """Keyframes without active points; the first holds candidates just off the truth."""
    corner = Corner(seed)
    window = build_window(corner)
    window.keep_points(np.zeros(window.points.shape[1], bool))
    table = cand.CandidateSelector(window.mask, CONFIG).select(window.images[0], 300, 0)
    T = window.keyframes[0].T_odom_cam
    truth = 1.0 / corner.depth_at(MIDDLE, T, *table[:2].astype(np.float64))
    table[ktr.LOW], table[ktr.HIGH] = 0.94 * truth, 1.05 * truth
    table[ktr.STATUS], table[ktr.INTERVAL_PX] = kep.GOOD, 1.0
    window.keyframes[0].candidates = table
    return window, truth


def test_well_traced_candidates_become_points_with_true_depths() -> None:
    window, truth = ready_window()
    table = window.keyframes[0].candidates.copy()
    count = cand.activate(window, 0.0, NOBODY)
    assert count == window.points.shape[1] > 150
    assert window.keyframes[0].candidates.shape[1] == 0
    assert np.all(window.host == 0)
    at = {(u, v): d for u, v, d in zip(table[0], table[1], truth, strict=True)}
    true = np.array([at[u, v] for u, v in window.points[:2].T])
    assert np.median(np.abs(window.points[kw.IDEPTH] / true - 1.0)) < 0.01
    assert np.all(window.residual[0] == kw.UNUSED)
    assert np.all((window.residual == kw.INLIER).any(axis=0))


@pytest.mark.parametrize(
    ("row", "value"),
    [(ktr.HIGH, np.nan), (ktr.STATUS, kep.BAD), (ktr.INTERVAL_PX, 9.0), (ktr.QUALITY, 2.0)],
    ids=["never traced", "bad match", "vague", "repeated texture"],
)
def test_others_wait(row: int, value: float) -> None:
    window, _ = ready_window()
    window.keyframes[0].candidates[row, ::2] = value
    n = window.keyframes[0].candidates.shape[1]
    cand.activate(window, 0.0, NOBODY)
    assert window.keyframes[0].candidates.shape[1] == -(-n // 2)


def test_candidates_near_active_points_stay_candidates() -> None:
    window, _ = ready_window()
    n = window.keyframes[0].candidates.shape[1]
    everywhere = np.mgrid[0:240:4, 0:180:4].reshape(2, -1).astype(np.float32)
    projected = np.vstack((everywhere, np.ones((1, everywhere.shape[1]), np.float32)))
    assert cand.activate(window, 4.0, projected) == 0
    left = window.keyframes[0].candidates.shape[1]
    assert 0.9 * n < left < n  # those that the newest frame does not see are given up
    assert window.points.shape[1] == 0


@pytest.mark.parametrize("waiting", [0, 1, 2])
def test_candidates_keep_their_order_in_memory_however_few_wait(waiting: int) -> None:
    window, _ = ready_window()
    window.keyframes[0].candidates[ktr.STATUS, :waiting] = kep.BAD
    everywhere = np.mgrid[0:240:4, 0:180:4].reshape(2, -1).astype(np.float32)
    cand.activate(window, 4.0, np.vstack((everywhere, np.ones_like(everywhere[:1]))))
    assert window.keyframes[0].candidates.flags.c_contiguous


def test_a_larger_distance_takes_fewer() -> None:
    counts = []
    for distance in (0.0, 2.0, 4.0):
        window, _ = ready_window()
        counts.append(cand.activate(window, distance, NOBODY))
    assert counts[0] > counts[1] > counts[2] > 10


def test_a_leaving_keyframe_gives_its_last_and_keeps_none() -> None:
    window, _ = ready_window()
    window.keyframes[0].candidates[ktr.STATUS, ::2] = kep.BAD
    window.keyframes[0].leaving = True
    assert cand.activate(window, 0.0, NOBODY) > 60
    assert window.keyframes[0].candidates.shape[1] == 0


def test_tracing_reaches_all_keyframes() -> None:
    corner = Corner(3)
    window = build_window(corner, points_per_frame=50)
    selector = cand.CandidateSelector(window.mask, CONFIG)
    for keyframe in window.keyframes[:3]:
        keyframe.candidates = selector.select(window.images[keyframe.slot], 100, 0)
    total = sum(k.candidates.shape[1] for k in window.keyframes)
    T = window.keyframes[-1].T_odom_cam @ se3.exp([0.02, 0, 0, 0, 0, 0])
    good = cand.trace_all(
        window, level_of(corner.image(MIDDLE, T)), se3.inverse(T), np.zeros(2), 40.0
    )
    assert 0.3 * total < good <= total
    for keyframe in window.keyframes[:3]:
        assert np.any(keyframe.candidates[ktr.STATUS] == kep.GOOD)


def test_the_window_without_keyframes_activates_nothing() -> None:
    window = Window(MIDDLE.pinhole, margin_mask(), CONFIG)
    assert cand.activate(window, 0.0, NOBODY) == 0
    nothing = Frame(0, 0, np.zeros((2, 2), np.uint8))
    level = np.zeros((MIDDLE.height, MIDDLE.width, 3), np.float32)
    window.add_keyframe(nothing, Pyramid((level,)), np.eye(4), np.zeros(2))
    assert cand.activate(window, 0.0, NOBODY) == 0
