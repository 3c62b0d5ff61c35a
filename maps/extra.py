# SPDX-License-Identifier: Apache-2.0
"""What layers that only some maps have must be able to do, to be carried by every tool."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol, Self

from edge.tiles.format import Array
from edge.tiles.manifest import LearnedEntry
from edge.tiles.reader import Map
from edge.types import I32

if TYPE_CHECKING:
    from maps.layers import TileContent


class Sizes(NamedTuple):
    """How much a map holds."""

    views: int
    points: int


class OwnTiles(Protocol):
    """A layer that lies in tiles of its own."""

    def write(self, folder: Path, tile_m: float) -> LearnedEntry:
        """Write its files into a map's folder; return their entry in the manifest."""


class ExtraLayer(Protocol):
    """An optional group of layers, of a whole map."""

    @classmethod
    def load(cls, opened: Map, keyframes: I32) -> Self | None:
        """The layer of a map, None if it has none; `keyframes` (views,) are those of the views."""

    @classmethod
    def joined(cls, first: Self | None, second: Self | None, sizes: tuple[Sizes, Sizes]) -> Self:
        """The layer of two maps in one; what one of them lacks stays empty."""

    def kept(self, view: I32, point: I32) -> Self:
        """The layer after some views and points are gone: new numbers of all, -1 of those."""

    def arrays(self, content: "TileContent") -> dict[str, Array]:
        """The arrays of one tile."""
