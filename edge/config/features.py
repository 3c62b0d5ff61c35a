# SPDX-License-Identifier: Apache-2.0
"""How ORB features are extracted: equal for a map and for every query against it."""

from typing import Annotated

import msgspec


class OrbConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the extractor; a map's manifest carries those it was built with."""

    # 640x480 indoors gives about this many that repeat; more cost matching time for few points.
    max_features: Annotated[int, msgspec.Meta(ge=50, le=20000)] = 1200
    # Pyramid of 3.6 times in all: an object is still known at a third of its distance.
    levels: Annotated[int, msgspec.Meta(ge=1, le=12)] = 8
    # ORB's own; descriptors of neighbouring levels still match at 1.2.
    scale_factor: Annotated[float, msgspec.Meta(ge=1.05, le=2.0)] = 1.2
    # Weakest corner worth having: below about this, sensor noise makes corners.
    min_contrast_grey: Annotated[int, msgspec.Meta(ge=3, le=60)] = 7
    # Features are shared out over cells of this size, so that dim regions get theirs.
    cell_px: Annotated[int, msgspec.Meta(ge=16, le=256)] = 32
