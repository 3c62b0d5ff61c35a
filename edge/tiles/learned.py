# SPDX-License-Identifier: Apache-2.0
"""The learned features of a map: tiles of their own, read as any map is."""

from pathlib import Path

import msgspec

from edge.errors import TileError
from edge.tiles.manifest import VocabularyEntry
from edge.tiles.reader import Map, tiles_of
from edge.tiles.residency import DEFAULT_BYTES

_OWN_SHARE = 0.75


class LearnedMap(Map):
    """A map as a learned model sees it; its keyframes and lines are those of the map.

    It takes most of the memory that the map's own tiles may hold.
    """

    def __init__(self, opened: Map, resident_bytes: int = DEFAULT_BYTES) -> None:
        learned = opened.manifest.learned
        if learned is None:
            raise TileError(
                f"{opened.folder} has no learned features; build it with --features MODEL.onnx"
            )
        words = learned.vocabulary
        manifest = msgspec.structs.replace(
            opened.manifest,
            extractor=learned.extractor,
            vocabulary=VocabularyEntry(id=words.sha256, words=words.words),
            counts=learned.counts,
            tiles=learned.tiles,
            labels=None,
            learned=None,
        )
        # One bound for both: of the map itself little more than lines is asked for.
        own = round(_OWN_SHARE * resident_bytes)
        opened.bound(resident_bytes - own)
        super().__init__(opened.folder, manifest, tiles_of(opened.folder, manifest), own)
        if (self.keyframe_source != opened.keyframe_source).any():
            raise TileError(f"{opened.folder}: its learned features are of other keyframes")
        self.vocabulary_file: Path = opened.folder / words.path
        self.lines = opened.lines
