# SPDX-License-Identifier: Apache-2.0
"""New candidate points of a keyframe, and their way to becoming active."""

import numpy as np

from edge.config.odometry import OdometryConfig
from edge.odometry import kernels_epipolar as kep
from edge.odometry import kernels_select as ksel
from edge.odometry import kernels_trace as ktr
from edge.odometry import kernels_window as kw
from edge.odometry.kernels_reference import project_points
from edge.odometry.kernels_refine import refine_inverse_depths
from edge.odometry.system import relative_affines, relative_warps
from edge.odometry.window import Window
from edge.types import F32, F64, I32, U8, Bools, Mat4

# A candidate whose match is no sharper than this is not used yet [px].
MAX_INTERVAL_PX = 8.0
# A baseline of fewer standard deviations is mostly error, and all depths along it err alike.
MIN_BASELINE_SIGMAS = 5.0
# Nor is one that moves things by less: errors that all pixels share are not in its sigma, such as
# those of a rolling shutter while the camera turns.
MIN_BASELINE_PX = 2.0
# How far apart active points are kept at most, in pixels of half the working size.
MAX_DISTANCE_PX = 4.0


class CandidateSelector:
    """Chooses pixels of new keyframes; adapts its spacing to get the wanted number."""

    def __init__(self, mask: U8, config: OdometryConfig) -> None:
        self._mask, self._config = mask, config
        self._spacing = 5
        rows, columns = -(-mask.shape[0] // ksel.REGION_PX), -(-mask.shape[1] // ksel.REGION_PX)
        self._thresholds = np.zeros((rows, columns), np.float32)
        self._picked = np.zeros((3, 30_000), np.int32)

    def select(self, level0: F32, wanted: int, seed: int) -> F32:
        """Candidate table (30, n) of about `wanted` pixels of a keyframe's level 0."""
        ksel.region_thresholds(
            level0, self._mask, 0.5, self._config.gradient_margin_grey, self._thresholds
        )
        for _ in range(4):
            count = ksel.pick(level0, self._mask, self._thresholds, self._spacing, self._picked)
            ratio = count / wanted
            # The count goes with the inverse square of the spacing.
            better = int(np.clip(round((self._spacing + 1) * np.sqrt(ratio) - 1), 1, 40))
            if 0.9 < ratio < 1.6 or better == self._spacing:
                break
            self._spacing = better
        chosen = np.arange(count)
        if count > wanted:
            rng = np.random.default_rng(seed)
            chosen = np.sort(rng.choice(count, wanted, replace=False))
        table = np.zeros((ktr.CANDIDATE_ROWS, len(chosen)), np.float32)
        table[[kw.U, kw.V, ktr.CELL]] = self._picked[:, chosen]
        ktr.describe(
            level0,
            np.float32(self._config.gradient_scale_grey),
            np.float32(self._config.outlier_grey),
            table,
        )
        return table


def trace_all(
    window: Window,
    level0: F32,
    T_cam_odom: Mat4,
    affine: F64,
    max_search_px: float,
    sigma_t: float = 0.0,
) -> int:
    """Search all candidates of the window in a new frame; how many hold a good interval.

    `sigma_t` is the uncertainty of the frame's place [odometry units].
    """
    good = 0
    least = max(MIN_BASELINE_SIGMAS * sigma_t, _least_baseline(window))
    searched = [k for k in window.keyframes if k.candidates.shape[1] > 0]
    warps = relative_warps([k.T_cam_odom for k in searched], [T_cam_odom]).astype(np.float32)
    for keyframe, warp in zip(searched, warps[:, 0], strict=True):
        if np.linalg.norm(warp[9:]) < least:
            continue
        gain = np.exp(affine[0] - keyframe.affine[0])
        brightness = np.array([gain, affine[1] - gain * keyframe.affine[1]], np.float32)
        good += ktr.trace(
            level0,
            window.mask,
            window.intrinsics,
            warp,
            brightness,
            np.float32(window.config.huber_grey),
            np.float32(max_search_px),
            keyframe.candidates,
        )
    return good


def _least_baseline(window: Window) -> float:
    """What moves a point of median depth by `MIN_BASELINE_PX`; 0 while there are no points."""
    if window.points.shape[1] == 0:
        return 0.0
    return MIN_BASELINE_PX / float(window.intrinsics[0] * np.median(window.points[kw.IDEPTH]))


def spread_distance(distance: float, active: int, wanted: int) -> float:
    """Next distance to keep between active points, so that their number meets `wanted`."""
    step = float(np.clip(2.5 * (active / wanted - 1.0), -0.8, 0.8))
    return float(np.clip(distance + step, 0.0, MAX_DISTANCE_PX))


def activate(window: Window, distance_px: float, projected: F32) -> int:
    """Turn well-traced candidates into active points where there are few; how many.

    projected  (3, n)  float32  the active points in the newest keyframe
    """
    tables, hosts = [], []
    for index, keyframe in enumerate(window.keyframes[:-1]):
        if keyframe.waits:
            continue
        table = keyframe.candidates
        ready, usable = _ready(table, window.config.min_uniqueness, leaving=keyframe.leaving)
        keyframe.candidates = np.ascontiguousarray(table[:, usable & ~ready])
        tables.append(table[:, ready])
        hosts.append(np.full(int(ready.sum()), index, np.int32))
    if not tables:
        return 0
    table, host = np.concatenate(tables, axis=1), np.concatenate(hosts)
    accepted, inside = _spread(window, table, host, distance_px, projected)
    _give_back(window, table, host, inside & ~accepted)
    table, host = np.ascontiguousarray(table[:, accepted]), host[accepted]
    if table.shape[1] == 0:
        return 0
    ok, good = refine(window, table, host)
    window.add_points(table[:, ok], host[ok], good[:, ok])
    return int(ok.sum())


def refine(window: Window, table: F32, host: I32) -> tuple[Bools, U8]:
    """Optimise the candidates' depths over the window: ok (n,) bool and good (f, n)."""
    keyframes = window.keyframes
    affines = np.stack([k.affine for k in keyframes])
    ok = np.zeros(table.shape[1], np.uint8)
    good = np.zeros((len(keyframes), table.shape[1]), np.uint8)
    refine_inverse_depths(
        window.images,
        window.mask,
        np.array([k.slot for k in keyframes], np.int32),
        host,
        table,
        window.intrinsics,
        relative_warps([k.T_cam_odom for k in keyframes]).astype(np.float32),
        relative_affines(affines, affines),
        affines[:, 1].astype(np.float32),
        np.float32(window.config.huber_grey),
        np.float32(window.config.gradient_scale_grey),
        1,
        ok,
        good,
    )
    table[kw.GOOD_VIEWS] = good.sum(axis=0)
    return ok > 0, good


def _ready(table: F32, min_uniqueness: float, *, leaving: bool) -> tuple[Bools, Bools]:
    """Candidates that may become active now, and those worth keeping."""
    status = table[ktr.STATUS]
    traced = np.isfinite(table[ktr.HIGH])
    ready = (
        traced
        & np.isin(status, (kep.GOOD, kep.SKIPPED, kep.FLAT, kep.OUT))
        & (table[ktr.INTERVAL_PX] < MAX_INTERVAL_PX)
        & (table[ktr.QUALITY] > min_uniqueness)
        & (table[ktr.LOW] + table[ktr.HIGH] > 0)
    )
    usable = (status != kep.OUT) & (not leaving)
    return ready, usable


def _spread(
    window: Window, table: F32, host: I32, distance_px: float, projected: F32
) -> tuple[Bools, Bools]:
    """Which candidates lie far enough from every active point: accepted, inside (n,) bool."""
    keyframes = window.keyframes
    warps = relative_warps([k.T_cam_odom for k in keyframes]).astype(np.float32)
    middle = np.ascontiguousarray(table[: kw.POINT_ROWS])
    middle[kw.IDEPTH] = 0.5 * (table[ktr.LOW] + table[ktr.HIGH])
    at = np.empty((3, table.shape[1]), np.float32)
    project_points(middle, host, warps, window.intrinsics, len(keyframes) - 1, at)
    height, width = window.mask.shape
    inside = (at[2] > 0) & (at[0] > 2) & (at[1] > 2) & (at[0] < width - 3) & (at[1] < height - 3)
    distance = np.empty((height // 2, width // 2), np.float32)
    ksel.distance_map(_half(projected[0]), _half(projected[1]), projected.shape[1], distance)
    order = np.argsort(table[ktr.INTERVAL_PX], kind="stable")
    order = order[inside[order]]
    taken = np.empty(len(order), np.uint8)
    ksel.accept_spread(
        _half(at[0][order]),
        _half(at[1][order]),
        (distance_px * table[ktr.CELL][order]).astype(np.float32),
        distance,
        taken,
        (window.config.points or 0) * 2 - window.points.shape[1],
    )
    accepted = np.zeros(table.shape[1], bool)
    accepted[order[taken > 0]] = True
    return accepted, inside


def _half(pixels: F32) -> F32:
    return np.ascontiguousarray((pixels + np.float32(0.5)) * np.float32(0.5) - np.float32(0.5))


def _give_back(window: Window, table: F32, host: I32, where: Bools) -> None:
    """Return candidates that found no room to their hosts, unless they can be seen no more."""
    alive = where & (table[ktr.STATUS] != kep.OUT)
    for index, keyframe in enumerate(window.keyframes[:-1]):
        mine = alive & (host == index)
        if np.any(mine) and not keyframe.leaving:
            both = np.concatenate((keyframe.candidates, table[:, mine]), axis=1)
            # NumPy chooses another order where one column was left: kernels would compile for it.
            keyframe.candidates = np.ascontiguousarray(both)
