# SPDX-License-Identifier: Apache-2.0
"""Cuts views and points into tiles, and lays out the arrays of each."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.tiles.format import Array
from edge.types import F64, I32
from maps.describe import Description
from maps.extra import ExtraLayer
from maps.layers import Places, TileContent, tile_layers
from maps.points import StoredPoints
from maps.views import View

I64 = NDArray[np.int64]
Cell = tuple[int, int, int]


class TileArrays(NamedTuple):
    """One tile, ready to be written."""

    cell: Cell
    origin: F64  # (3,)
    low: F64  # (3,) corner of its points and camera centres
    high: F64  # (3,)
    n_keyframes: int
    n_points: int
    layers: dict[str, Array]


def assemble(
    views: list[View],
    descriptions: list[Description],
    points: StoredPoints,
    tile_m: float,
    n_words: int,
    extra: tuple[ExtraLayer, ...] = (),
) -> list[TileArrays]:
    """Tiles in the order of their cells."""
    centres = np.array([view.T_map_cam[:3, 3] for view in views])
    cells, tile_of_view = np.unique(
        np.floor(centres / tile_m + 0.5).astype(np.int64), axis=0, return_inverse=True
    )
    keyframes = _places(tile_of_view.reshape(-1).astype(np.int32))
    point_places = _places(keyframes.tile[points.view[points.offsets[:-1]]])
    tiles = []
    for number, cell in enumerate(cells):
        chosen = np.flatnonzero(keyframes.tile == number)
        own_points = np.flatnonzero(point_places.tile == number)
        origin = cell * tile_m
        content = TileContent(
            number, chosen, own_points, origin, views, descriptions, points, keyframes,
            point_places, extra,
        )  # fmt: skip
        corners = np.concatenate([centres[chosen], points.xyz[own_points]])
        tiles.append(
            TileArrays(
                (int(cell[0]), int(cell[1]), int(cell[2])),
                origin,
                corners.min(axis=0),
                corners.max(axis=0),
                len(chosen),
                len(own_points),
                tile_layers(content, n_words),
            )
        )
    return tiles


def _places(tile: I32) -> Places:
    """Number the members of each tile in their order."""
    local = np.zeros(len(tile), np.int32)
    for number in np.unique(tile):
        members = np.flatnonzero(tile == number)
        local[members] = np.arange(len(members))
    return Places(tile, local)
