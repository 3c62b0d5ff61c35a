# SPDX-License-Identifier: Apache-2.0
"""Whether soft shades move over what the camera sees: a lamp that it carries, its own shadow.

Points then differ in brightness from how their keyframes saw them, and are more alike in images
that are freed of shades. Where light is even they are less so: such images lack what is the same.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from edge.image.pyramid import Undistortion
from edge.image.shade import bilinear, gain_by_cells, sampled_gain
from edge.odometry import kernels_window as kw
from edge.odometry.window import Window
from edge.odometry.window_points import not_newest
from edge.types import F32, F64

_LEAST_POINTS = 60
_HOSTS = 3  # keyframes that are compared with the newest: those of the most points
# Of so many keyframes in a row the middle one must gain so much. Kitchens, offices and plain rooms
# in even light had -0.02 at most, a bare and shining corridor 0.04; spotlights 0.21 and more.
_KEYFRAMES, _ENOUGH = 3, 0.15
# A window that shades have drawn along goes on without them where that moves its keyframes by no
# more of its path on average: on real and ray-cast drives by 0.022 at most. One that was nowhere
# near the truth moved by 0.1, and was still elsewhere.
MAX_MOVED_PATHS = 0.05
_DARK_GREY = 20.0  # added to all: ratios of next to nothing tell nothing
_OUTLYING = 3.0  # spreads beyond which a point counts no more
_SPREAD_OF_MEDIAN = 1.4826  # of a normal deviate, in median absolute deviations


class LightWatch:
    """Follows one odometry. Owned by the thread of the keyframe work."""

    def __init__(self) -> None:
        self._told: deque[float] = deque(maxlen=_KEYFRAMES)
        # By the frames' indices, with what their images were made by: each is made once.
        self._gains: dict[int, tuple[Undistortion, F32 | None]] = {}

    def is_uneven(self, window: Window, projected: F32) -> bool:
        """Whether the last keyframes show shades; `projected` as in `gain_by_evening`."""
        told = gain_by_evening(window, projected, self._gains_of(window))
        if told is not None:
            self._told.append(told)
        return len(self._told) == _KEYFRAMES and float(np.median(self._told)) > _ENOUGH

    def _gains_of(self, window: Window) -> list[F32 | None]:
        """Gains by cells of the window's keyframes."""
        gains: dict[int, tuple[Undistortion, F32 | None]] = {}
        for keyframe in window.keyframes:
            index, made_by = keyframe.frame.index, keyframe.undistortion
            known = self._gains.get(index)
            if known is None or known[0] is not made_by:
                image = window.images[keyframe.slot][..., 0]
                known = made_by, gain_by_cells(image, window.mask)
            gains[index] = known
        self._gains = gains
        return [gain for _, gain in gains.values()]


def gain_by_evening(window: Window, projected: F32, gains: Sequence[F32 | None]) -> float | None:
    """How much more alike points look without shades: log of the ratio of their differences.

    projected  (3, n)  float32  as of `project`, in the newest keyframe
    gains      of each keyframe, as of `gain_by_cells`

    None where too few points tell.
    """
    newest = window.keyframes[-1]
    image = window.images[newest.slot][..., 0]
    height, width = image.shape
    u, v = projected[:2]
    use = not_newest(window) & (window.residual[-1] == kw.INLIER) & (projected[2] > 0.0)
    use &= (u >= 3) & (v >= 3) & (u < width - 4) & (v < height - 4)
    counts = np.bincount(window.host[use], minlength=len(window.keyframes))
    hosts = np.argsort(-counts, kind="stable")[:_HOSTS]
    use &= np.isin(window.host, hosts)
    gain = gains[-1]
    if np.count_nonzero(use) < _LEAST_POINTS or gain is None:
        return None
    u, v, host = u[use], v[use], window.host[use]
    here = bilinear(image, u + kw.PATTERN_U[:, None], v + kw.PATTERN_V[:, None]).mean(axis=0)
    at = window.points[:, use]
    there = at[kw.GREY : kw.GREY + kw.PATTERN_SIZE].mean(axis=0).astype(np.float64)
    lit_here = here * sampled_gain(gain, u, v)
    seen, evened = np.empty(len(here)), np.empty(len(here))
    for index in np.unique(host):
        mine = host == index
        gain = gains[index]
        if gain is None:
            return None
        lit_there = there[mine] * sampled_gain(gain, at[kw.U, mine], at[kw.V, mine])
        seen[mine] = _left_over(here[mine], there[mine])
        evened[mine] = _left_over(lit_here[mine], lit_there)
    return float(np.log(max(_spread(seen), 1e-9) / max(_spread(evened), 1e-9)))


def _left_over(here: F64, there: F64) -> F64:
    """What no change of exposure explains of the log ratio of greys (n,)."""
    off = np.log((here + _DARK_GREY) / (there + _DARK_GREY))
    return np.asarray(off - np.median(off))


def _spread(values: F64) -> float:
    most = _limit(values)
    return float(np.sqrt(np.mean(np.clip(values, -most, most) ** 2)))


def _limit(values: F64) -> float:
    return _OUTLYING * _SPREAD_OF_MEDIAN * float(np.median(np.abs(values)))
