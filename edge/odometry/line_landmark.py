# SPDX-License-Identifier: Apache-2.0
"""One line of the window: made of views that agree, trusted once others confirm it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.lines.line import Lines
from edge.lines.structure import triangulate, views_of
from edge.odometry.line_tracks import View
from edge.types import F64, Pinhole

# Working-size pixels from a line beyond which a view shows another edge; and beyond which it
# does not confirm a line that is not trusted yet.
STRAY_PX, CONFIRMED_PX = 0.64, 0.38
# Views that make a line, and with the one that confirms it: three fit a wrong line too well.
MIN_VIEWS = 3
_TRUSTED_VIEWS = MIN_VIEWS + 1
# Squared sigmas, two freedoms each, beyond which a view loses its weight where a line is made.
_CAUCHY2 = 9.0
_MAX_FAILURES = 2  # of a line that is not trusted
# A line that is known worse, as a share of its depth, or in its direction, pairs with anything.
_MAX_SIGMA_SHARE, _MAX_SIGMA_RAD = 0.2, 0.3


@dataclass(slots=True, eq=False)
class Line:
    """A straight edge as a landmark, in the odometry frame."""

    point: F64
    direction: F64
    span: F64  # (2,) from the point
    views: list[View]
    failures: int = 0
    unseen: int = 0  # keyframes since it was
    retried: bool = False
    is_trusted: bool = False

    def held(self) -> list[View]:
        """Views of keyframes in the window."""
        return [view for view in self.views if view.keyframe is not None]

    def try_out(self, camera: Pinhole) -> bool:
        """Make a line that is not trusted anew of all its views; whether it may stay."""
        again = made(self.views, camera, CONFIRMED_PX)
        if again is None:
            self.failures += 1
            return self.failures < _MAX_FAILURES
        self.point, self.direction, self.span = again.point, again.direction, again.span
        if len(self.views) >= _TRUSTED_VIEWS:
            self.is_trusted, self.failures = True, 0
        return True


def made(views: Sequence[View], camera: Pinhole, reach_px: float = STRAY_PX) -> Line | None:
    """The line that views show; None where one is further off, or they leave it open."""
    seen = [(view.segments, view.index, view.T_cam_odom) for view in views]
    found = triangulate([views_of(seen)], camera, _CAUCHY2)
    sigma_px = np.array([view.segments.sigma[view.index] for view in views])
    if np.max(off_px(found.m2[0], sigma_px)) > reach_px or not _is_sure(found.lines, views):
        return None
    point, direction, span = found.lines.point[0], found.lines.direction[0], found.span[0]
    if not _runs_like(point, direction, views[-1], camera):
        direction, span = -direction, -span[::-1]
    return Line(point, direction, span, list(views))


def off_px(m2: F64, sigma_px: F64) -> F64:
    """How far views (n,) are off a line, of squared distances in sigmas, two freedoms each."""
    return np.asarray(sigma_px * np.sqrt(0.5 * m2))


def _runs_like(point: F64, direction: F64, view: View, p: Pinhole) -> bool:
    """Whether a line's direction is that of its segment, and not the opposite."""
    T = view.T_cam_odom
    P, D = T[:3, :3] @ point + T[:3, 3], T[:3, :3] @ direction
    moved = np.array([p.fx * (D[0] * P[2] - P[0] * D[2]), p.fy * (D[1] * P[2] - P[1] * D[2])])
    return bool(moved @ view.segments.direction[view.index] > 0.0)


def _is_sure(line: Lines, views: Sequence[View]) -> bool:
    """Whether a line lies ahead of its views, and how deep is known at least roughly."""
    T = np.array([view.T_cam_odom for view in views])
    depth = T[:, 2, :3] @ line.point[0] + T[:, 2, 3]
    sigma = np.sqrt(np.diag(line.covariance[0]))
    return bool(
        depth.min() > 0.0
        and sigma[:2].max() < _MAX_SIGMA_SHARE * depth.min()
        and sigma[2:].max() < _MAX_SIGMA_RAD
    )
