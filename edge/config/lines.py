# SPDX-License-Identifier: Apache-2.0
"""How line segments are found, measured and paired with lines in space."""

from typing import Annotated

import msgspec


class SegmentConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the detector; lengths are those of the full-size image."""

    # Shorter ones turn by degrees with the noise and are seldom found again.
    min_length_px: Annotated[float, msgspec.Meta(ge=10.0, le=500.0)] = 30.0
    # The longest ones; more cost matching time and add little to a pose.
    max_segments: Annotated[int, msgspec.Meta(ge=4, le=2000)] = 150
    # Weakest step across a line worth measuring: below about this, noise makes edges.
    min_contrast_grey: Annotated[float, msgspec.Meta(ge=2.0, le=100.0)] = 6.0
    # Pieces of one edge differ by less; two edges of a batten by more.
    merge_across_px: Annotated[float, msgspec.Meta(gt=0.0, le=10.0)] = 1.5
    merge_angle_deg: Annotated[float, msgspec.Meta(gt=0.0, le=15.0)] = 2.5
    # A gap may be as long as this share of the shorter of its two pieces.
    merge_gap_share: Annotated[float, msgspec.Meta(ge=0.0, le=2.0)] = 0.7
    # What lens and interpolation leave, however many pixels lie along a line.
    floor_px: Annotated[float, msgspec.Meta(gt=0.0, le=2.0)] = 0.1


class PairingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the association by votes."""

    # Between a projected line and its segment; parallel neighbours are told apart by offset only.
    angle_deg: Annotated[float, msgspec.Meta(gt=0.0, le=30.0)] = 6.0
    # Of its samples that must meet the segment: half of it may be hidden.
    min_share: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.5
    # Lines that show less of themselves are not looked for.
    min_length_px: Annotated[float, msgspec.Meta(ge=5.0, le=500.0)] = 20.0


class ThreeViewConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings for matching segments over three views of known pose."""

    # Of an end transferred to the third view: noise of two segments, carried by a short baseline.
    reach_px: Annotated[float, msgspec.Meta(gt=0.0, le=50.0)] = 4.0
    angle_deg: Annotated[float, msgspec.Meta(gt=0.0, le=30.0)] = 5.0
    # Between the sides of one line in two views, at equal brightness of the images.
    max_grey: Annotated[float, msgspec.Meta(gt=0.0, le=255.0)] = 25.0
