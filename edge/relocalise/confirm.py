# SPDX-License-Identifier: Apache-2.0
"""From matches to a pose that has been looked at twice."""

from typing import NamedTuple

import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.geometry.camera import CameraModel
from edge.relocalise import absolute_pose, calibration, retrieve, rows
from edge.relocalise.assessment import Solution, gain_of
from edge.relocalise.calibration import LensEvidence
from edge.relocalise.correspondences import Correspondences, pose_difference
from edge.relocalise.exposure import can_show
from edge.relocalise.features import Features
from edge.relocalise.gates import (
    AMBIGUOUS,
    UNCERTAIN,
    WRONG_LENS,
    Fitting,
    Seen,
    seen_from,
    visible_share,
    why_not,
)
from edge.relocalise.lens import lens_shifts, magnification
from edge.relocalise.match import Matches, match_near, most_promising
from edge.relocalise.pool import Pool, PoolMaker
from edge.relocalise.projection import Projection, View, project
from edge.relocalise.rows import RowsEvidence
from edge.tiles.reader import Map
from edge.types import U8, Mat4, Mat6

_PRIOR_CHI2 = 22.5  # 99.9 % of six degrees of freedom
_SAME_PLACE_CHI2 = 11.34  # 99 % of three degrees of freedom
# Far enough that nothing there is right, near enough that the texture is alike.
_SHIFT_PX = (90.0, -60.0)
# Where so many of the matches fit, a search among them all finds nothing better.
_PLAIN_SHARE = 0.6


class Attempt(NamedTuple):
    """What came of one way to find an image."""

    reason: str  # "ok", or why it is not believed
    candidates: tuple[int, ...]  # map keyframes that were asked
    matches: int = 0
    solution: Solution | None = None
    pool: Pool | None = None  # that the solution's matches are of
    found: Matches | None = None
    seen: Seen | None = None
    foretold: bool = False  # the solution lies where a prior had it
    lens: LensEvidence | None = None  # what a solution that is right as far as it goes tells of it
    lens_wrong: bool = False  # by this image and the last ones together
    rows: RowsEvidence | None = None  # what a believed solution tells of a turn between rows


class Prior(NamedTuple):
    """Where the image is believed to have been taken."""

    T_map_cam: Mat4
    covariance: Mat6


class Image(NamedTuple):
    """Features to be found in the map, and the seed of all chance in it."""

    features: Features
    seed: int
    clipped: U8 | None = None  # (h, w), 1 where the image can show nothing


class Confirmer:
    """Searches poses for matches, looks again from there, and judges what it then sees.

    Owned by the relocaliser's thread, with the pools that it shares.
    """

    def __init__(
        self, map_: Map, pools: PoolMaker, camera: CameraModel, config: RelocaliseConfig
    ) -> None:
        self._map = map_
        self._pools = pools
        self._lens, self._camera = camera, camera.pinhole
        self._config = config
        self._scale_factor = map_.manifest.extractor.scale_factor
        self._last: tuple[tuple[Features, Pool, Matches], Correspondences] | None = None

    def search(
        self, image: Image, pool: Pool, found: Matches, T_prior: Mat4 | None = None
    ) -> Mat4 | None:
        """Pose that explains the matches best; one led from the prior is among those tried."""
        matches = self._correspondences(image, pool, found)
        led = None
        if T_prior is not None:
            led = absolute_pose.lead(T_prior, matches, self._camera, self._config)
            if led.share >= _PLAIN_SHARE:
                return led.T_map_cam
        searched = absolute_pose.search(
            matches, most_promising(found, pool), self._camera, image.seed, self._config
        )
        if led is not None and (searched is None or led.gain >= searched[1]):
            return led.T_map_cam
        return None if searched is None else searched[0]

    def rival(self, image: Image, pool: Pool, found: Matches, T_map_cam: Mat4) -> Mat4 | None:
        """Best pose for the matches that `T_map_cam` leaves over, if it is worth a look."""
        config = self._config
        matches = self._correspondences(image, pool, found)
        own = gain_of(matches, T_map_cam, self._camera, config)
        others = absolute_pose.unexplained(matches, T_map_cam, self._camera, config)
        left = Matches(*(column[others] for column in found))
        if len(left.feature) < config.min_matches:
            return None
        searched = absolute_pose.search(
            self._correspondences(image, pool, left),
            most_promising(left, pool),
            self._camera,
            image.seed,
            config,
        )
        if searched is None or searched[1] < config.tried_rival_share * own:
            return None
        return searched[0]

    def confirm(
        self,
        image: Image,
        pool: Pool,
        found: Matches,
        T_start: Mat4,
        prior: Prior | None = None,
        *,
        rough: bool = False,
    ) -> Attempt:
        """Look again from the pose: match what should be seen from there, solve, and judge.

        A `rough` pose is one by what lay anywhere in the map: it is looked from twice, first for
        what is near it and in windows as wide as it is uncertain.
        """
        tried = tuple(pool.keyframes.tolist())
        n_first = len(found.feature)
        matches = self._correspondences(image, pool, found)
        solution = absolute_pose.solve_from(T_start, matches, self._camera, self._config)
        if solution is None:
            return Attempt("no pose", tried, n_first)
        if rough:
            around = self._looked_around(image, solution)
            if around is None:
                return Attempt("not seen again", tried, n_first)
            pool, solution = around
        T = solution.T_map_cam
        projection, found = self._look(image, pool, T, None)
        matches = self._correspondences(image, pool, found)
        solution = absolute_pose.solve_from(T, matches, self._camera, self._config, coarse=False)
        if solution is None:
            return Attempt("not seen again", tried, n_first)
        seen = self._seen(image, pool, projection, found, solution)
        foretold = prior is not None and _agrees(solution, prior)
        reason = why_not(solution, seen, self._config, foretold=foretold)
        lens, sound = None, reason == "ok" or reason in UNCERTAIN
        if sound and seen.evidence >= self._config.min_evidence:
            lens = calibration.evidence(solution, matches, self._lens)
        if lens is not None and calibration.is_wrong(calibration.error_of([lens]), self._config):
            reason = WRONG_LENS
        turned = rows.evidence(solution, matches, self._lens) if reason == "ok" else None
        return Attempt(
            reason, tried, n_first, solution, pool, found, seen, foretold, lens, rows=turned
        )

    def _looked_around(self, image: Image, rough: Solution) -> tuple[Pool, Solution] | None:
        """What lies near a pose, and the pose by what is seen of that."""
        T, config = rough.T_map_cam, self._config
        keyframes = retrieve.near(self._map, self._pools, T, config.guided_keyframes)
        pool = self._pools.make(sorted(keyframes))
        _, found = self._look(image, pool, T, rough.covariance)
        if len(found.feature) >= config.min_matches:
            # Half a place has two poses that look alike: more matches tell them apart.
            again = self.search(image, pool, found, T)
            T = T if again is None else again
        matches = self._correspondences(image, pool, found)
        solution = absolute_pose.solve_from(T, matches, self._camera, config)
        return None if solution is None else (pool, solution)

    def project(
        self, pool: Pool, T: Mat4, covariance: Mat6 | None, windows: tuple[float, float]
    ) -> Projection:
        """Project a pool into the camera at T; None means that T is exact."""
        view = View(T, covariance, self._lens)
        return project(pool, view, self._scale_factor, self._config, windows)

    def _look(
        self, image: Image, pool: Pool, T: Mat4, covariance: Mat6 | None
    ) -> tuple[Projection, Matches]:
        """Where the pool should appear from T, and what is matched there."""
        config = self._config
        greatest = config.final_max_px if covariance is None else config.guided_max_px
        projection = self.project(pool, T, covariance, (config.final_px, greatest))
        return projection, match_near(image.features, pool, projection, self._camera, config)

    def _seen(
        self,
        image: Image,
        pool: Pool,
        projection: Projection,
        found: Matches,
        solution: Solution,
    ) -> Seen:
        """What is seen from the last projection, and what chance would have matched there."""
        rows = np.flatnonzero(projection.radius_px > 0.0)
        points, first = np.unique(pool.point[rows], return_index=True)
        n_looked_for = len(points)
        shown = can_show(image.clipped, projection.centre[points], self._lens)
        points, first = points[shown], first[shown]
        expected = projection.centre[points]
        visible = visible_share(projection.level[rows[first]], image.features.octave)
        shifted = projection._replace(centre=projection.centre + _SHIFT_PX)
        by_chance = match_near(image.features, pool, shifted, self._camera, self._config)
        chance = len(by_chance.feature) / max(n_looked_for, 1)
        pixels = image.features.pixels[found.feature]
        found_there = Fitting(pixels, solution.inlier, chance, visible)
        return seen_from(expected, found_there, self._camera, self._config)

    def _correspondences(self, image: Image, pool: Pool, found: Matches) -> Correspondences:
        """Matches as solvers take them; the last ones are kept, since most are asked for twice."""
        asked, last = (image.features, pool, found), self._last
        if last is None or any(a is not b for a, b in zip(asked, last[0], strict=True)):
            self._last = last = asked, self._made(*asked)
        return last[1]

    def _made(self, features: Features, pool: Pool, found: Matches) -> Correspondences:
        point = pool.point[found.row]
        octave = features.octave[found.feature]
        pixels = features.pixels[found.feature].astype(np.float64)
        here = self._lens.normalise(pixels)
        variance = absolute_pose.pixel_variance(octave, self._scale_factor, self._config)
        return Correspondences(
            pixels,
            pool.xyz[point],
            pool.C[point],
            variance * magnification(self._lens, here) ** 2,
            pool.axis[found.row],
            lens_shifts(self._lens, here, pool.seen_at[found.row], self._config),
        )


def stronger(first: Attempt, second: Attempt, config: RelocaliseConfig) -> Attempt:
    """Of two attempts the one that explains more; ambiguous if they are nearly as good."""
    better, worse = first, second
    if _gain(second) > _gain(first):
        better, worse = second, first
    if better.solution is None or worse.solution is None or better.reason != "ok":
        return better
    alike = _gain(worse) > config.max_rival_share * _gain(better)
    if alike and not _same_place(better.solution, worse.solution):
        return better._replace(reason=AMBIGUOUS)
    return better


def _agrees(solution: Solution, prior: Prior) -> bool:
    """Whether a solution lies where the prior has it."""
    off = pose_difference(solution.T_map_cam, prior.T_map_cam)
    return float(off @ np.linalg.solve(solution.covariance + prior.covariance, off)) < _PRIOR_CHI2


def _gain(attempt: Attempt) -> float:
    return 0.0 if attempt.solution is None else attempt.solution.gain


def _same_place(a: Solution, b: Solution) -> bool:
    """Whether two solutions differ by less than they are uncertain."""
    apart = a.T_map_cam[:3, 3] - b.T_map_cam[:3, 3]
    covariance = a.covariance[:3, :3] + b.covariance[:3, :3]
    return float(apart @ np.linalg.solve(covariance, apart)) < _SAME_PLACE_CHI2
