# SPDX-License-Identifier: Apache-2.0
"""The learned features of a map: found beside ORB's in the same views, in tiles of their own."""

import hashlib
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from edge.config.features import OrbConfig
from edge.errors import ModelRefused
from edge.learned.extractor import stated
from edge.learned.model import LearnedModel
from edge.relocalise.bow import Vocabulary
from edge.store import durable
from edge.tiles.learned import LearnedMap
from edge.tiles.manifest import Counts, LearnedEntry, WordsFile
from edge.tiles.reader import Map
from edge.types import DepthSamples
from maps.assemble import assemble
from maps.content import Content, join, load, select
from maps.describe import Description, LearnedSpec
from maps.labels.looking import Sightings
from maps.labels.moving import without_moving
from maps.points import store
from maps.posing import adapted
from maps.settings import BuildSettings
from maps.shutter_build import with_rows_at_once
from maps.survey import Survey
from maps.views import ViewSet
from maps.vocabulary_training import train
from maps.writer import write_tile

LAYER = "learned_"
_WORDS_PATH = f"tiles/{LAYER}words.tile"
_MOST_TAUGHT = 200  # views that the vocabulary is trained on: some 200 000 features
# Of 256 bits. Between posed views only what lies on an epipolar line is compared.
_MAX_BITS = 80
_NO_SAMPLES = DepthSamples(
    np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty(0, np.float32)
)


class LearnedLayer(NamedTuple):
    """Learned features of all views, ready to be written."""

    model: str
    sha256: str
    extractor: OrbConfig
    vocabulary: bytes
    content: Content

    def kept(self, keyframes: list[int]) -> "LearnedLayer":
        """What some keyframes, ascending, still see."""
        return self._replace(content=select(self.content, keyframes))

    def joined(
        self, other: "LearnedLayer", sequences: int, cameras: list[int]
    ) -> "LearnedLayer | None":
        """Both layers in one, None where they are of two models; see `maps.content.join`.

        The other's words are told anew, by the features that it has stored.
        """
        if (self.sha256, self.extractor) != (other.sha256, other.extractor):
            return None
        words = Vocabulary(self.vocabulary, _WORDS_PATH)
        retold = [
            one._replace(words=words.describe(one.features.descriptors))
            for one in other.content.descriptions
        ]
        second = other.content._replace(descriptions=retold)
        return self._replace(content=join(self.content, second, sequences, cameras))

    def write(self, folder: Path, tile_m: float) -> LearnedEntry:
        """Write tiles and vocabulary into a map's folder; return their entry in the manifest."""
        views, descriptions, points, _ = self.content
        words = Vocabulary(self.vocabulary, _WORDS_PATH).n_words
        tiles = assemble(views, descriptions, points, tile_m, words)
        entries = [write_tile(folder, number, tile, LAYER) for number, tile in enumerate(tiles)]
        durable.write_new(folder / _WORDS_PATH, [self.vocabulary])
        return LearnedEntry(
            model=self.model,
            sha256=self.sha256,
            extractor=self.extractor,
            vocabulary=WordsFile(
                path=_WORDS_PATH,
                bytes=len(self.vocabulary),
                sha256=hashlib.sha256(self.vocabulary).hexdigest(),
                words=words,
            ),
            counts=Counts(
                keyframes=len(views), points=len(points.xyz), observations=len(points.view)
            ),
            tiles=entries,
        )


def spec_of(path: Path, extractor: OrbConfig) -> LearnedSpec:
    """How views are described by a model; ModelRefused, before any work, where it is no good."""
    return LearnedSpec(path.resolve(), LearnedModel(path).sha256, extractor.max_features)


def learned_layer(
    chosen: ViewSet,
    described: list[Description],
    survey: Survey,
    settings: BuildSettings,
    seen: Sightings | None = None,
) -> LearnedLayer:
    """Find what a model sees in the views; `described` by ORB they tell which are alike.

    What moves by itself is left out where it was `seen`.
    """
    spec = survey.learned
    assert spec is not None
    # Depths of the right camera or of other images are known at ORB's corners only.
    depth = settings.depth if settings.depth in ("given", "lidar") else "none"
    settings = msgspec.structs.replace(
        settings, depth=depth, max_bits=_MAX_BITS, max_turn_deg=360.0
    )
    found = without_moving(adapted(chosen, survey.describe(chosen, settings)), chosen, seen)
    descriptions = [
        one._replace(words=orb.words, samples=_NO_SAMPLES)
        for one, orb in zip(found, described, strict=True)
    ]
    measured = survey.measure(chosen, descriptions, settings)
    _, descriptions, sides, points = with_rows_at_once(measured, survey.measure, settings)
    if len(points.xyz) == 0:
        raise ModelRefused(f"{spec.path}: none of its key points is seen from two of the views")
    vocabulary = _trained(descriptions)
    words = Vocabulary(vocabulary, _WORDS_PATH)
    descriptions = [
        one._replace(words=words.describe(one.features.descriptors)) for one in descriptions
    ]
    poses = [view.T_map_cam for view in chosen.views]
    stored = store(points, poses, sides, settings.max_stored_features)
    content = Content(chosen.views, descriptions, stored)
    return LearnedLayer(spec.path.name, spec.sha256, survey.extractor, vocabulary, content)


def load_layer(opened: Map) -> LearnedLayer | None:
    """The learned features of a map, None where it has none."""
    entry = opened.manifest.learned
    if entry is None:
        return None
    learned = LearnedMap(opened)
    content = load(learned)._replace(extra={})
    vocabulary = learned.vocabulary_file.read_bytes()
    return LearnedLayer(entry.model, entry.sha256, entry.extractor, vocabulary, content)


def survey_of(spec: LearnedSpec, beside: Survey) -> Survey:
    """A survey by a model, sharing workers and kept results with that by ORB."""
    return Survey(stated(spec.max_features), beside.workers, beside.work, spec)


def _trained(descriptions: list[Description]) -> bytes:
    """A vocabulary of this map's own features."""
    taught = descriptions[:: -(-len(descriptions) // _MOST_TAUGHT)]
    codes = [one.features.descriptors for one in taught]
    images = np.repeat(np.arange(len(codes), dtype=np.int32), [len(c) for c in codes])
    return train(np.concatenate(codes), images, origin="the map's own images")
