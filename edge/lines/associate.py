# SPDX-License-Identifier: Apache-2.0
"""Which found segment shows which line in space, from a predicted pose."""

from typing import NamedTuple

import numpy as np

from edge.config.lines import PairingConfig
from edge.lines import kernels_associate
from edge.lines.line import Lines, Segments
from edge.types import F64, I32, Mat4, Pinhole

_MARGIN_PX = 4.0  # segments are not measured nearer to the image's border


class Pairs(NamedTuple):
    """Lines and the segments that show them, one to one."""

    line: I32  # (k,)
    segment: I32  # (k,)
    offset_px: F64  # (k,) from the projected line to its segment, along its normal
    expected: I32  # lines that should be seen, paired or not


def associate(
    lines: Lines,
    span: F64,
    segments: Segments,
    camera: Pinhole,
    T_cam_lines: Mat4,
    reach_px: F64 | float,
    config: PairingConfig,
) -> Pairs:
    """Pair lines with segments by votes from samples along projected lines, along their normals.

    span : (n, 2) part of each line that is known to exist, from its point
    reach_px : how far from its projection a line may be, (n,) or for all
    """
    first = lines.point + span[:, :1] * lines.direction
    last = lines.point + span[:, 1:] * lines.direction
    n = len(first)
    projected = np.empty((n, 4))
    kernels_associate.project(first, last, T_cam_lines, camera, _MARGIN_PX, projected)
    extent = np.hypot(projected[:, 2] - projected[:, 0], projected[:, 3] - projected[:, 1])
    projected[~(extent >= config.min_length_px)] = np.nan
    reach = np.broadcast_to(np.asarray(reach_px, np.float64), (n,)).copy()
    match, share, offset = np.empty(n, np.int32), np.empty(n), np.empty(n)
    cosine = float(np.cos(np.deg2rad(config.angle_deg)))
    kernels_associate.vote(projected, reach, *segments[:3], cosine, match, share, offset)
    match[share < config.min_share] = -1
    chosen = _one_to_one(match, share * np.nan_to_num(extent), np.abs(offset))
    expected = np.flatnonzero(np.isfinite(projected[:, 0])).astype(np.int32)
    return Pairs(chosen, match[chosen], offset[chosen], expected)


def _one_to_one(match: I32, votes: F64, distance: F64) -> I32:
    """Lines (k,) that keep their segment: of those that claim one, the one with most votes."""
    order = np.lexsort((distance, -votes))
    order = order[match[order] >= 0]
    _, first = np.unique(match[order], return_index=True)
    return np.sort(order[first]).astype(np.int32)
