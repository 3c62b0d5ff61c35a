# SPDX-License-Identifier: Apache-2.0
"""The stage that finds single images in a map."""

import msgspec
import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.geometry.camera import CameraModel
from edge.lines.work import Clock, no_clock
from edge.relocalise import retrieve
from edge.relocalise.assessment import Solution
from edge.relocalise.bow import vocabulary_of
from edge.relocalise.calibration import LensWatch
from edge.relocalise.confirm import Attempt, Confirmer, Image, Prior, stronger
from edge.relocalise.exposure import clipped
from edge.relocalise.features import Extractor, Features, OrbExtractor
from edge.relocalise.gates import AMBIGUOUS, UNCERTAIN, WRONG_LENS
from edge.relocalise.lens import read_at_once
from edge.relocalise.line_fixes import LineFixes
from edge.relocalise.match import Matches, match_all, match_near
from edge.relocalise.pool import Pool, PoolMaker
from edge.relocalise.scale import log_scale
from edge.relocalise.seeds import depths
from edge.tiles.reader import Map
from edge.types import Fix, Mat4, Mat6, Query

_REMEMBERED_KEYFRAMES = 64  # of about 100 kB each
_ROWS_ROUNDS = 2  # a far turn is told too short at first: its shear has cost matches


class Relocaliser:
    """Finds the pose of an image in a map, or says why not.

    Owned by one thread. Where an image was taken depends on its query alone, and chance is seeded
    by the frame's index; whether the lens is as it was calibrated, the last images tell together.
    """

    def __init__(
        self,
        map_: Map,
        camera: CameraModel,
        config: RelocaliseConfig,
        extractor: Extractor | None = None,
        clock: Clock = no_clock,
    ) -> None:
        """`extractor` is that of the map's learned features, where `map_` is of those.

        `clock` tells what looking for lines costs.
        """
        self._map = map_
        self._camera = map_.camera_for(camera)
        self._pinhole = self._camera.pinhole
        self._config = config = _with_lens_checked(config, map_, self._camera)
        self._vocabulary = vocabulary_of(map_)
        self._extractor = extractor or OrbExtractor(map_.manifest.extractor)
        self._pools = PoolMaker(map_, _REMEMBERED_KEYFRAMES)
        self._confirmer = Confirmer(map_, self._pools, self._camera, config)
        self._lens_watch = LensWatch(config)
        self._lines = LineFixes(map_, self._camera, config, clock)

    def step(self, query: Query) -> Fix:
        """Fix of the query's frame: found with pose and covariance, or why not."""
        if self._lines.guides(query):
            return self._lines.alone(query)
        features = self._extractor.extract(query.frame.image, self._camera)
        if query.rows_turned_rad is not None:
            features = read_at_once(features, query.rows_turned_rad, self._camera)
        attempt = self._weighed(self.attempt(features, query))
        return self._lines.added(query, self._fix(query, attempt))

    def _weighed(self, attempt: Attempt) -> Attempt:
        """The attempt in the light of what the last images together tell of the lens."""
        solution = attempt.solution
        if attempt.lens is None or solution is None or attempt.reason == AMBIGUOUS:
            return attempt
        self._lens_watch.add(solution, attempt.lens)
        if self._lens_watch.is_wrong:
            return attempt._replace(reason=WRONG_LENS, lens_wrong=True)
        covariance = solution.covariance + self._lens_watch.doubt(attempt.lens)
        return attempt._replace(solution=solution._replace(covariance=covariance))

    def attempt(self, features: Features, query: Query) -> Attempt:
        """Find the features, by the prior if there is a good one, else anywhere in the map.

        A query's image that is not of the camera's size is none: features are all that is known.
        """
        if len(features.pixels) < self._config.min_matches:
            return Attempt("few features", ())
        grey = query.frame.image
        known = grey.shape == (self._camera.height, self._camera.width)
        image = Image(features, query.frame.index + 1, clipped(grey) if known else None)
        T_prior, covariance = query.T_map_cam_prior, query.prior_covariance
        if self._config.guided and T_prior is not None and covariance is not None:
            guided = self._guided(image, Prior(T_prior, covariance))
            # What lies where it should and is only too uncertain is not to be found elsewhere.
            if guided.reason == "ok" or (guided.foretold and guided.reason in UNCERTAIN):
                return self._read_at_once(image, guided, Prior(T_prior, covariance))
        return self._read_at_once(image, self._lost(image, T_prior))

    def _read_at_once(
        self, image: Image, attempt: Attempt, prior: Prior | None = None, rounds: int = _ROWS_ROUNDS
    ) -> Attempt:
        """The attempt with the image freed of a turn while its rows were read, if it tells one.

        Only what is believed without is made better: what is left over of the wrong place looks
        like such a turn as well, and without it more of it would fit.
        """
        solution, turned = attempt.solution, attempt.rows
        if solution is None or turned is None or turned.chi2 < self._config.rows_chi2:
            return attempt
        assert attempt.pool is not None
        assert attempt.found is not None
        features = read_at_once(image.features, turned.turned_rad, self._camera)
        freed = image._replace(features=features)
        again = self._confirmer.confirm(
            freed, attempt.pool, attempt.found, solution.T_map_cam, prior
        )
        least = self._config.rows_gain * np.count_nonzero(solution.inlier)
        if again.solution is None or again.solution.gain < solution.gain + least:
            return attempt
        again = _less_certain(again, turned.doubt)
        return self._read_at_once(freed, again, prior, rounds - 1) if rounds > 1 else again

    def _guided(self, image: Image, prior: Prior) -> Attempt:
        """Project the map by the prior and match in windows."""
        config = self._config
        self._map.expect(prior.T_map_cam[:3, 3])
        keyframes = retrieve.near(self._map, self._pools, prior.T_map_cam, config.guided_keyframes)
        pool = self._pools.make(sorted(keyframes))
        windows = (config.guided_min_px, config.guided_max_px)
        projection = self._confirmer.project(pool, *prior, windows)
        found = match_near(image.features, pool, projection, self._pinhole, config)
        tried = tuple(keyframes)
        if len(found.feature) < config.min_matches:
            return Attempt("few guided matches", tried, len(found.feature))
        T_start = self._confirmer.search(image, pool, found, prior.T_map_cam)
        if T_start is None:
            return Attempt("no pose", tried, len(found.feature))
        return self._confirmer.confirm(image, pool, found, T_start, prior)

    def _lost(self, image: Image, T_prior: Mat4 | None) -> Attempt:
        """Ask the words, match everything with the best keyframes' points, search a pose."""
        config = self._config
        keyframes = retrieve.by_words(self._map, self._vocabulary, image.features, config)
        if T_prior is not None:
            near = retrieve.near(self._map, self._pools, T_prior, config.near_last_place)
            keyframes = list(dict.fromkeys((*near, *keyframes)))
        if not keyframes:
            return Attempt("no candidates", ())
        pool = self._pools.make(keyframes)
        found = match_all(image.features, pool, config)
        nothing = Attempt("few matches", tuple(keyframes), len(found.feature))
        if len(found.feature) < config.min_matches:
            return nothing
        T_start = self._confirmer.search(image, pool, found)
        if T_start is None:
            return nothing._replace(reason="no pose")
        attempt = self._confirmer.confirm(image, pool, found, T_start, rough=True)
        T_rival = self._confirmer.rival(image, pool, found, T_start)
        if T_rival is None:
            return attempt
        other = self._confirmer.confirm(image, pool, found, T_rival, rough=True)
        return stronger(attempt, other, config)

    def _fix(self, query: Query, attempt: Attempt) -> Fix:
        frame, solution = query.frame, attempt.solution
        if solution is None or attempt.pool is None or attempt.found is None:
            return Fix(
                frame.index,
                frame.t_ns,
                query.odom_id,
                query.T_odom_cam,
                False,
                attempt.reason,
                attempt.candidates,
                attempt.matches,
            )
        scale: tuple[float, float] | tuple[None, None] = (None, None)
        if query.depth is not None:
            T = solution.T_map_cam
            told = log_scale(attempt.pool, T, self._pinhole, query.depth, self._config)
            scale = (None, None) if told is None else told
        for array in (solution.T_map_cam, solution.covariance):
            array.flags.writeable = False
        return Fix(
            frame.index,
            frame.t_ns,
            query.odom_id,
            query.T_odom_cam,
            attempt.reason == "ok",
            attempt.reason,
            attempt.candidates,
            len(attempt.found.feature),
            int(np.count_nonzero(solution.inlier)),
            solution.T_map_cam,
            solution.covariance,
            _support(attempt.pool, attempt.found, solution),
            scale[0],
            scale[1],
            solution.depth_m,
            depth=depths(attempt.pool, attempt.found, solution, self._pinhole),
            lens_wrong=attempt.lens_wrong,
        )


def _with_lens_checked(
    config: RelocaliseConfig, map_: Map, camera: CameraModel
) -> RelocaliseConfig:
    """How well the lens is known, if it is that of a map which tried to better it."""
    if map_.manifest.build.get("lens") != "refined" or camera not in map_.cameras:
        return config
    return msgspec.structs.replace(
        config,
        lens_focal_share=config.lens_checked_share * config.lens_focal_share,
        lens_corner_share=config.lens_checked_share * config.lens_corner_share,
    )


def _less_certain(attempt: Attempt, doubt: Mat6) -> Attempt:
    """The attempt with a covariance that holds a doubt as well."""
    solution = attempt.solution
    assert solution is not None
    return attempt._replace(solution=solution._replace(covariance=solution.covariance + doubt))


def _support(pool: Pool, found: Matches, solution: Solution) -> tuple[int, ...]:
    """Map keyframes whose points the inliers are, most first."""
    slots = pool.slot[found.row[solution.inlier]]
    counts = np.bincount(slots, minlength=len(pool.keyframes))
    order = np.lexsort((np.arange(len(counts)), -counts))
    return tuple(int(pool.keyframes[s]) for s in order if counts[s] > 0)
