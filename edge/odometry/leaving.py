# SPDX-License-Identifier: Apache-2.0
"""Which points and keyframes leave the window."""

import numpy as np

from edge.config.odometry import OdometryConfig
from edge.odometry import kernels_window as kw
from edge.odometry.keyframe import Keyframe
from edge.odometry.window import Window

# A keyframe leaves when fewer of its points than this share are still active.
MIN_SHARE_REMAINING = 0.05
MAX_BRIGHTNESS_CHANGE = 0.7
# A point that leaves is worth keeping as information when it was seen so often.
MIN_GOOD_VIEWS = 3
MIN_DEPTH_INFORMATION = 50.0


def flag_leaving(window: Window, config: OdometryConfig) -> None:
    """Mark keyframes with few points left, or, when there are too many, a well-placed one."""
    keyframes = window.keyframes
    newest = keyframes[-1]
    capacity = config.window_keyframes or 0
    staying = len(keyframes)
    for index, keyframe in enumerate(keyframes[:-2]):
        active = int(np.count_nonzero(window.host == index))
        remaining = active + keyframe.candidates.shape[1]
        changed = abs(newest.affine[0] - keyframe.affine[0]) > MAX_BRIGHTNESS_CHANGE
        few = remaining < MIN_SHARE_REMAINING * (config.candidates or 0)
        if (few or changed) and staying > capacity - 2:
            keyframe.leaving = True
            staying -= 1
    while staying > capacity:
        _farthest_from_usefulness(keyframes).leaving = True
        staying -= 1


def let_go(window: Window) -> None:
    """Marginalise points that are no longer seen, then the keyframes that leave."""
    leaving = np.array([k.leaving for k in window.keyframes])
    gone = (window.misses >= 2) | leaving[window.host]
    alive = np.count_nonzero(window.residual == kw.INLIER, axis=0)
    worth = (
        gone
        & (alive >= 2)
        & (window.points[kw.GOOD_VIEWS] >= MIN_GOOD_VIEWS)
        & (window.depth_information > MIN_DEPTH_INFORMATION)
    )
    window.keep_points(~(gone & ~worth))
    window.marginalise_points(gone[~(gone & ~worth)])
    for index in reversed(np.flatnonzero(leaving)):
        window.marginalise_keyframe(int(index))


def _farthest_from_usefulness(all_keyframes: list[Keyframe]) -> Keyframe:
    """The keyframe crowded by others and far from the newest (Engel et al. 2018, eq. 20)."""
    keyframes = [k for k in all_keyframes if not k.leaving]
    centres = np.stack([k.T_odom_cam[:3, 3] for k in keyframes])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    best, lowest = keyframes[0], np.inf
    for i, keyframe in enumerate(keyframes[:-2]):
        others = [j for j in range(len(keyframes) - 1) if j != i]
        crowding = float(np.sum(1.0 / (1e-5 + apart[i, others])))
        score = -np.sqrt(apart[i, -1]) * crowding
        if score < lowest:
            best, lowest = keyframe, float(score)
    return best
