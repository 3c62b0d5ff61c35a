# SPDX-License-Identifier: Apache-2.0
"""The stage that finds single images in a map."""

from typing import NamedTuple

import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.errors import TileError
from edge.geometry.camera import CameraModel
from edge.relocalise import absolute_pose, retrieve
from edge.relocalise.absolute_pose import Correspondences, Solution
from edge.relocalise.bow import shipped_vocabulary
from edge.relocalise.features import Features, OrbExtractor
from edge.relocalise.gates import why_not
from edge.relocalise.match import Matches, match_all, match_near, most_promising
from edge.relocalise.pool import Pool, PoolMaker
from edge.relocalise.projection import Projection, View, project
from edge.relocalise.scale import log_scale
from edge.tiles.reader import Map
from edge.types import Fix, Mat4, Mat6, Query

_REMEMBERED_KEYFRAMES = 64  # of about 40 kB each


class Attempt(NamedTuple):
    """What came of one way to find an image."""

    reason: str  # "ok", or why it is not believed
    candidates: tuple[int, ...]
    matches: int = 0
    solution: Solution | None = None
    pool: Pool | None = None
    found: Matches | None = None
    seen_share: float = 0.0
    rival_share: float = 0.0


class Relocaliser:
    """Finds the pose of an image in a map, or says why not.

    Owned by one thread. Each answer depends on its query alone: nothing is learnt from one for
    the next, and chance is seeded by the frame's index.
    """

    def __init__(self, map_: Map, camera: CameraModel, config: RelocaliseConfig) -> None:
        self._map = map_
        self._camera = camera
        self._pinhole = camera.pinhole
        self._config = config
        self._vocabulary = shipped_vocabulary()
        if map_.manifest.vocabulary.id != self._vocabulary.id:
            raise TileError(f"{map_.folder} was built with another vocabulary; build it again")
        self._extractor = OrbExtractor(map_.manifest.extractor)
        self._scale_factor = map_.manifest.extractor.scale_factor
        self._pools = PoolMaker(map_, _REMEMBERED_KEYFRAMES)

    def step(self, query: Query) -> Fix:
        """Fix of the query's frame: found with pose and covariance, or why not."""
        features = self._extractor.extract(query.frame.image, self._camera)
        attempt = self.attempt(features, query)
        return self._fix(query, attempt)

    def attempt(self, features: Features, query: Query) -> Attempt:
        """Find the features, by the prior if there is a good one, else anywhere in the map."""
        if len(features.pixels) < self._config.min_matches:
            return Attempt("few features", ())
        if query.T_map_cam_prior is not None and query.prior_covariance is not None:
            guided = self._guided(features, query, query.T_map_cam_prior, query.prior_covariance)
            if guided.reason == "ok":
                return guided
        return self._lost(features, query)

    def _guided(self, features: Features, query: Query, T_prior: Mat4, covariance: Mat6) -> Attempt:
        """Project the map by the prior and match in windows."""
        config = self._config
        keyframes = retrieve.near(self._map, self._pools, T_prior, config.guided_keyframes)
        pool = self._pools.make(keyframes)
        windows = (config.guided_min_px, config.guided_max_px)
        projection = self._project(pool, T_prior, covariance, windows)
        found = match_near(features, pool, projection, self._pinhole, config)
        if len(found.feature) < config.min_matches:
            return Attempt("few guided matches", tuple(keyframes), len(found.feature))
        T_start = self._search(features, pool, found, query, T_prior)
        return self._confirmed(features, pool, found, T_start)

    def _lost(self, features: Features, query: Query) -> Attempt:
        """Ask the words, match everything with the best keyframes' points, search a pose."""
        config = self._config
        keyframes = retrieve.by_words(self._map, self._vocabulary, features, config)
        if query.T_map_cam_prior is not None:
            near = retrieve.near(self._map, self._pools, query.T_map_cam_prior, config.covisible)
            keyframes = list(dict.fromkeys((*near, *keyframes)))
        if not keyframes:
            return Attempt("no candidates", ())
        pool = self._pools.make(keyframes)
        found = match_all(features, pool, config)
        if len(found.feature) < config.min_matches:
            return Attempt("few matches", tuple(keyframes), len(found.feature))
        T_start = self._search(features, pool, found, query, None)
        if T_start is None:
            return Attempt("no pose", tuple(keyframes), len(found.feature))
        attempt = self._confirmed(features, pool, found, T_start)
        if attempt.reason != "ok" or attempt.solution is None:
            return attempt
        rival = self._rival_share(features, pool, found, attempt.solution, query)
        reason = "ambiguous" if rival > config.max_rival_share else "ok"
        return attempt._replace(reason=reason, rival_share=rival)

    def _search(
        self,
        features: Features,
        pool: Pool,
        found: Matches,
        query: Query,
        T_prior: Mat4 | None,
    ) -> Mat4 | None:
        """Pose that explains the matches best; the prior's own is one of those tried."""
        matches = self._correspondences(features, pool, found)
        searched = absolute_pose.search(
            matches, most_promising(found, pool), self._pinhole, _seed(query), self._config
        )
        if T_prior is None:
            return None if searched is None else searched[0]
        led = absolute_pose.solve_from(T_prior, matches, self._pinhole, self._config)
        if searched is None or (led is not None and led.gain >= searched[1]):
            return T_prior if led is None else led.T_map_cam
        return searched[0]

    def _confirmed(
        self, features: Features, pool: Pool, found: Matches, T_start: Mat4 | None
    ) -> Attempt:
        """Look again from the pose: match what should be seen from there, solve, and judge."""
        config = self._config
        tried = tuple(pool.keyframes.tolist())
        n_first = len(found.feature)
        matches = self._correspondences(features, pool, found)
        if T_start is None:
            return Attempt("no pose", tried, n_first)
        solution = absolute_pose.solve_from(T_start, matches, self._pinhole, config)
        if solution is None:
            return Attempt("no pose", tried, n_first)
        seen_share = 0.0
        # Once with windows as wide as the first pose is uncertain, then with narrow ones.
        for exact in (False, True):
            T = solution.T_map_cam
            pool = self._pools.make(
                retrieve.near(self._map, self._pools, T, config.guided_keyframes)
            )
            windows = (config.final_px, config.final_px if exact else config.guided_max_px)
            projection = self._project(pool, T, None if exact else solution.covariance, windows)
            found = match_near(features, pool, projection, self._pinhole, config)
            matches = self._correspondences(features, pool, found)
            again = absolute_pose.solve_from(T, matches, self._pinhole, config)
            if again is None:
                return Attempt("not seen again", tried, n_first, solution)
            solution = again
            seen_share = _seen_share(pool, projection, found, solution)
        reason = why_not(solution, seen_share, config)
        return Attempt(reason, tried, n_first, solution, pool, found, seen_share)

    def _rival_share(
        self, features: Features, pool: Pool, found: Matches, solution: Solution, query: Query
    ) -> float:
        """How well the best pose for all other matches explains them, as a share of this one."""
        matches = self._correspondences(features, pool, found)
        own = absolute_pose.gain_of(matches, solution.T_map_cam, self._pinhole, self._config)
        others = absolute_pose.unexplained(matches, solution.T_map_cam, self._pinhole, self._config)
        left = Matches(*(column[others] for column in found))
        if len(left.feature) < self._config.min_matches:
            return 0.0
        rival = absolute_pose.search(
            self._correspondences(features, pool, left),
            most_promising(left, pool),
            self._pinhole,
            _seed(query),
            self._config,
        )
        return 0.0 if rival is None else rival[1] / max(own, 1e-9)

    def _project(
        self, pool: Pool, T: Mat4, covariance: Mat6 | None, windows: tuple[float, float]
    ) -> Projection:
        view = View(T, covariance, self._pinhole)
        return project(pool, view, self._scale_factor, self._config, windows)

    def _correspondences(self, features: Features, pool: Pool, found: Matches) -> Correspondences:
        point = pool.point[found.row]
        octave = features.octave[found.feature]
        return Correspondences(
            features.pixels[found.feature].astype(np.float64),
            pool.xyz[point],
            pool.C[point],
            absolute_pose.pixel_variance(octave, self._scale_factor, self._config),
        )

    def _fix(self, query: Query, attempt: Attempt) -> Fix:
        solution, found, pool = attempt.solution, attempt.found, attempt.pool
        nothing = Fix(
            query.frame.index,
            query.frame.t_ns,
            query.odom_id,
            query.T_odom_cam,
            False,
            attempt.reason,
            attempt.candidates,
            attempt.matches,
        )
        if solution is None or found is None or pool is None:
            return nothing
        scale = self._scale(query, solution, pool)
        for array in (solution.T_map_cam, solution.covariance):
            array.flags.writeable = False
        return Fix(
            query.frame.index,
            query.frame.t_ns,
            query.odom_id,
            query.T_odom_cam,
            attempt.reason == "ok",
            attempt.reason,
            attempt.candidates,
            len(found.feature),
            int(np.count_nonzero(solution.inlier)),
            solution.T_map_cam,
            solution.covariance,
            _support(pool, found, solution),
            None if scale is None else scale[0],
            None if scale is None else scale[1],
            solution.depth_m,
        )

    def _scale(self, query: Query, solution: Solution, pool: Pool) -> tuple[float, float] | None:
        if query.depth is None:
            return None
        return log_scale(pool, solution.T_map_cam, self._pinhole, query.depth, self._config)


def _seed(query: Query) -> int:
    return query.frame.index + 1


def _seen_share(pool: Pool, projection: Projection, found: Matches, solution: Solution) -> float:
    """Share of the points that should be found from a pose and are."""
    expected = np.unique(pool.point[projection.radius_px > 0.0])
    return np.count_nonzero(solution.inlier) / max(len(expected), 1)


def _support(pool: Pool, found: Matches, solution: Solution) -> tuple[int, ...]:
    """Map keyframes whose points the inliers are, most first."""
    slots = pool.slot[found.row[solution.inlier]]
    counts = np.bincount(slots, minlength=len(pool.keyframes))
    order = np.lexsort((np.arange(len(counts)), -counts))
    return tuple(int(pool.keyframes[s]) for s in order if counts[s] > 0)
