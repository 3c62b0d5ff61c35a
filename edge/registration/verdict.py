# SPDX-License-Identifier: Apache-2.0
"""What becomes of a fix."""

from dataclasses import dataclass

import numpy as np

from edge.types import Fix


@dataclass(frozen=True, slots=True)
class FixVerdict:
    """Whether a fix moved the anchor, and why not."""

    accepted: bool
    reason: str


def flaw_of(fix: Fix) -> str | None:
    """Why a fix cannot be used at all, or None."""
    if not fix.found:
        return fix.reason
    if fix.T_map_cam is None or fix.covariance is None or fix.depth_m is None:
        return "incomplete"
    return None if has_pose(fix) else "not a number"


def has_pose(fix: Fix) -> bool:
    """Whether it tells a pose with a covariance, of a fix that was refused as well."""
    if fix.T_map_cam is None or fix.covariance is None or fix.depth_m is None:
        return False
    return bool(np.all(np.isfinite(fix.T_map_cam)) and np.all(np.isfinite(fix.covariance)))
