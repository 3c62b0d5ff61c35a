# SPDX-License-Identifier: Apache-2.0
"""Frames of a rolling shutter in fast turns, tracked again with their rows put straight.

Rows that are read one after another while the camera turns are shifted against each other. The
pose takes that for a translation, and depths are then looked for along a baseline that is none.
What the tracking itself says of the turn is exact enough to take it off; what the motion before
foretells is not.
"""

import numpy as np

from edge.geometry import se3
from edge.image.pyramid import STILL, Pyramid, PyramidBuilder
from edge.odometry.last_motion import LastMotion
from edge.odometry.motion import rates
from edge.odometry.reference import Reference
from edge.odometry.tracker import Tracked, Tracker, better
from edge.types import F64, Frame

# Below this shift between the first row and the last one [px of level 0] it gains nothing.
MIN_SHIFT_PX = 3.0
# The turn is told less exactly where the translation has taken some of it: then once more.
LEFT_SHIFT_PX = 1.0
# By so much better must the straight rows agree. A hand turns unevenly: with any gain that sufficed
# (twelve drives) map poses became a tenth worse; even turns gain far more.
CLEARLY = 1.1


def tracked_straight(
    frame: Frame,
    first: tuple[Tracked, Pyramid],
    before: LastMotion,
    reference: Reference,
    tracker: Tracker,
    builder: PyramidBuilder,
) -> tuple[Tracked, Pyramid]:
    """How `frame` is tracked without what its turning did to its rows, and the image for that.

    `first` is how it was tracked as it is, from the last pyramid of `builder`: void afterwards.
    """
    tracked, pyramid = first
    for least_px in (MIN_SHIFT_PX, LEFT_SHIFT_PX):
        turning = _turning(frame, tracked, before, reference)
        change = float(np.linalg.norm(turning - pyramid.turning))
        if abs(builder.readout_s) * change * builder.pinholes[0].fx < least_px:
            break
        straight = builder.build(frame.image, turning, instead=True)
        guess = iter((tracked.T_cam_reference,))
        again = tracker.track(straight, reference, guess, tracked.affine, np.inf)
        if not better(again, tracked, CLEARLY):
            return tracked, builder.build(frame.image, pyramid.turning, instead=True)
        tracked, pyramid = again, straight
    return tracked, pyramid


def _turning(frame: Frame, tracked: Tracked, before: LastMotion, reference: Reference) -> F64:
    """Angular rate (3,) since the last frame [rad/s, camera axes]; none where that is missing."""
    if before.t_ns is None or before.gap > 1:
        return STILL
    T_reference_last = se3.inverse(reference.T_odom_cam) @ before.T_odom_cam
    return rates(tracked.T_cam_reference @ T_reference_last, frame.t_ns - before.t_ns).turning
