# SPDX-License-Identifier: Apache-2.0
"""What one image gives to a map by itself: features, words, depths. Runs in worker processes."""

import threading
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.config.features import OrbConfig
from edge.errors import RecordingError
from edge.relocalise.bow import shipped_vocabulary
from edge.relocalise.features import Extractor, Features, OrbExtractor
from edge.tiles.index import BowVector
from edge.types import F32, F64, DepthSamples
from maps.depth.given import depth_at, depth_samples
from maps.depth.lidar import lidar_depth, read_scan
from maps.depth.stereo import StereoMatcher
from maps.settings import BuildSettings
from maps.views import View


class Description(NamedTuple):
    """One described view."""

    features: Features
    words: BowVector
    depth: F64  # (n,) along z of each feature, 0 where unknown
    depth_sigma: F64  # (n,) its standard deviation
    samples: DepthSamples


class LearnedSpec(NamedTuple):
    """A model that describes in ORB's place."""

    path: Path
    sha256: str
    max_features: int


class DescribeContext(NamedTuple):
    """What all views have in common."""

    roots: tuple[Path, ...]
    extractor: OrbConfig | LearnedSpec
    settings: BuildSettings
    # Drawn anew by each build: what a lasting worker remembers of the last one does not count.
    build: str


class _Describers(threading.local):
    """The describer that a thread last used."""

    context: DescribeContext | None = None
    describer: "Describer"


_describers = _Describers()


def describe_view(context: DescribeContext, view: View) -> Description:
    """Describe one view; runs wherever the work is done."""
    if _describers.context != context:
        _describers.describer = Describer(list(context.roots), context.extractor, context.settings)
        _describers.context = context
    return _describers.describer.describe(view)


class Describer:
    """Describes views, whichever come; one of a thread."""

    def __init__(
        self, roots: list[Path], extractor: OrbConfig | LearnedSpec, settings: BuildSettings
    ) -> None:
        cv2.setNumThreads(1)
        self._roots = roots
        self._settings = settings
        self._config = extractor
        self._extractor = _opened(extractor)
        self._recordings: dict[int, Recording] = {}
        self._stereo: dict[int, StereoMatcher] = {}

    def describe(self, view: View) -> Description:
        """Return the description of a view; RecordingError if its image cannot be read.

        Words of a learned model are left out: its vocabulary is made of what all views show.
        """
        recording = self._recording(view.sequence)
        image = recording.needed_image(view.image)
        features = self._extractor.extract(image, recording.camera_at(view.image))
        learned = isinstance(self._config, LearnedSpec)
        described = features.descriptors[: 0 if learned else None]
        words = shipped_vocabulary().describe(described)
        depth, sigma, samples = self._depths(recording, view, features)
        return Description(features, words, depth, sigma, samples)

    def _recording(self, sequence: int) -> Recording:
        if sequence not in self._recordings:
            self._recordings[sequence] = open_recording(self._roots[sequence])
        return self._recordings[sequence]

    def _depths(
        self, recording: Recording, view: View, features: Features
    ) -> tuple[F64, F64, DepthSamples]:
        none = np.zeros(len(features.pixels))
        if self._settings.depth in ("given", "lidar"):
            depth = self._depth_image(recording, view)
            image = recording.image(view.image)
            if depth is not None and image is not None:
                values, sigma = depth_at(depth, features.raw_pixels, features.octave)
                count = self._settings.max_depth_samples
                camera = recording.camera_at(view.image)
                return values, sigma, depth_samples(image, depth, camera, count)
        if self._settings.depth == "stereo":
            matcher = self._stereo_matcher(recording, view.sequence)
            right = recording.right(view.image)
            if right is not None:
                values, sigma = matcher.depths(features, right)
                return values, sigma, _as_samples(features.pixels, values, sigma)
        return none, none, _no_samples()

    def _depth_image(self, recording: Recording, view: View) -> F32 | None:
        if self._settings.depth == "given":
            return recording.depth(view.image)
        T_cam_lidar = recording.T_cam_lidar
        if T_cam_lidar is None:
            raise RecordingError(
                f"{recording.root}: has no laser scans; --depth lidar needs velodyne/ and the line "
                "'Tr:' in calib.txt"
            )
        scan = recording.lidar_file(view.image)
        if scan is None:
            return None
        return lidar_depth(read_scan(scan), T_cam_lidar, recording.camera_at(view.image))

    def _stereo_matcher(self, recording: Recording, sequence: int) -> StereoMatcher:
        if sequence not in self._stereo:
            assert isinstance(self._config, OrbConfig)
            self._stereo[sequence] = StereoMatcher(recording, self._config)
        return self._stereo[sequence]


def _opened(extractor: OrbConfig | LearnedSpec) -> Extractor:
    if isinstance(extractor, OrbConfig):
        return OrbExtractor(extractor)
    # Imported here: ONNX Runtime takes time and memory that ORB does not need.
    from edge.learned.extractor import LearnedExtractor
    from edge.learned.model import LearnedModel

    return LearnedExtractor(LearnedModel(extractor.path), extractor.max_features)


def _as_samples(pixels: F32, depth: F64, sigma: F64) -> DepthSamples:
    known = depth > 0.0
    inverse = 1.0 / depth[known]
    return DepthSamples(
        pixels[known],
        inverse.astype(np.float32),
        (sigma[known] * inverse**2).astype(np.float32),
    )


def _no_samples() -> DepthSamples:
    empty = np.empty(0, np.float32)
    return DepthSamples(np.empty((0, 2), np.float32), empty, empty)
