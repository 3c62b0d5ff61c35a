# SPDX-License-Identifier: Apache-2.0
"""What a keyframe sees of the map's points."""

from typing import Any

import numpy as np

from edge.tiles.reader import NO_POINT, KeyframeFeatures, Map
from edge.types import F64


def seen_points(map_: Map, k: int) -> tuple[KeyframeFeatures, F64]:
    """Features of keyframe `k` whose points the map has, and the places (n, 3) of these [m].

    Points of a tile that is not in the map it has not.
    """
    features = map_.features(k)
    rows = np.flatnonzero(features.point != NO_POINT)
    columns: list[Any] = [column[rows] for column in features]
    known = KeyframeFeatures(*columns)
    return known, map_.points(known.point).xyz
