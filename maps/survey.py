# SPDX-License-Identifier: Apache-2.0
"""What a build learns from its images: features, matches, points; shared out and kept."""

from collections.abc import Iterator
from functools import partial
from hashlib import sha256
from secrets import token_hex

import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.config.features import OrbConfig
from edge.geometry import se3
from edge.relocalise.bow import shipped_vocabulary
from edge.runtime.progress import progress
from edge.types import Mat4
from maps.describe import DescribeContext, Description, LearnedSpec, describe_view
from maps.fusion import fuse
from maps.lens_build import Measured
from maps.matching import (
    MatchedSide,
    Matches,
    MatchSide,
    MatchTask,
    match_side,
    match_with_others,
)
from maps.pairs import choose_pairs
from maps.settings import BuildSettings
from maps.tracks import join
from maps.views import View, ViewSet
from maps.work_folder import WorkFolder, key_of, stamp
from maps.workers import Workers


class Survey:
    """Describes and matches the images of one build. Owned by one thread."""

    def __init__(
        self,
        extractor: OrbConfig,
        workers: Workers,
        work: WorkFolder,
        learned: LearnedSpec | None = None,
    ) -> None:
        """With a `learned` model that one describes, and `extractor` says what it is like."""
        self.extractor = extractor
        self.learned = learned
        self.workers = workers
        self.work = work

    def describe(self, chosen: ViewSet, settings: BuildSettings) -> list[Description]:
        """Descriptions of all views."""
        by = self.learned or self.extractor
        context = DescribeContext(tuple(chosen.roots), by, settings, token_hex(8))
        recordings = [open_recording(root) for root in chosen.roots]
        keys = [_key(context, recordings[view.sequence], view) for view in chosen.views]
        found = self.work.map(
            self.workers, partial(describe_view, context), chosen.views, keys, Description
        )
        return list(progress(found, len(chosen.views), "images"))

    def measure(
        self, chosen: ViewSet, descriptions: list[Description], settings: BuildSettings
    ) -> Measured:
        """Match the views and fuse what they see."""
        sides = [
            match_side(
                described.features,
                chosen.cameras[view.camera].pinhole,
                self.extractor,
                described.depth,
                described.depth_sigma,
            )
            for view, described in zip(chosen.views, descriptions, strict=True)
        ]
        poses = [view.T_map_cam for view in chosen.views]
        words = [described.words for described in descriptions]
        pairs = choose_pairs(poses, words, shipped_vocabulary().n_words, settings)
        matched = progress(self._matched(sides, poses, pairs, settings), len(pairs), "pairs")
        counts = [len(side.rays) for side in sides]
        tracks = join(counts, matched, [side.depth > 0.0 for side in sides])
        return Measured(chosen, descriptions, sides, fuse(tracks, poses, sides, settings))

    def _matched(
        self,
        sides: list[MatchSide],
        poses: list[Mat4],
        pairs: list[tuple[int, int]],
        settings: BuildSettings,
    ) -> Iterator[tuple[int, int, Matches]]:
        """Matches of all pairs, in their order."""
        others: dict[int, list[int]] = {}
        for i, j in pairs:
            others.setdefault(i, []).append(j)
        digests = [_digest(side) for side in sides]
        tasks, keys = [], []
        for i, seconds in others.items():
            T = np.array([se3.inverse(poses[j]) @ poses[i] for j in seconds])
            tasks.append(MatchTask(sides[i], tuple(sides[j] for j in seconds), T, settings))
            keys.append(key_of("matches", settings, digests[i], *(digests[j] for j in seconds), T))
        found = self.work.map(self.workers, match_with_others, tasks, keys, MatchedSide)
        for (i, seconds), matched in zip(others.items(), found, strict=True):
            for j, matches in zip(seconds, matched.split(), strict=True):
                yield i, j, matches


def _key(context: DescribeContext, recording: Recording, view: View) -> str:
    camera = recording.camera_at(view.image)
    rig = camera, recording.right_camera, recording.T_left_right, recording.T_cam_lidar
    files = [stamp(path) for path in recording.files(view.image)]
    settings = context.settings
    what = (context.extractor, settings.depth, settings.max_depth_samples)
    return key_of("description", what, *rig, *files)


def _digest(side: MatchSide) -> bytes:
    digest = sha256(repr(side.pinhole).encode())
    for array in (side.pixels, side.bits, side.angle_rad, side.sigma, side.depth, side.depth_sigma):
        digest.update(array.tobytes())
    return digest.digest()
