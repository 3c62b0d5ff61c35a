# SPDX-License-Identifier: Apache-2.0
"""Where a thing is that several images show, and what space it takes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge.changes.cover import holds
from edge.changes.glimpse import Glimpse
from edge.geometry import se3
from edge.geometry.covariance import largest_sigma
from edge.types import F64, Bools

_PASSES = 6
_DOUBTED = 2.0  # deviations aside, from which on a line of sight is believed less: it is of another
_MANY = 4  # lines of sight, that can outvote one
_ANGLE_RAD = 0.004  # poses and pixels are wrong by so much
_OF_SPREAD = 0.2  # the middle of a mask moves over the thing by so much of its half
_CUT = 4.0  # times as much where the image's border cuts it
_FRONT = 0.6  # of its half lies between the front and the middle
# Measured distances of a thing say no more than so many: they are wrong together, as where all are
# of the wall behind it.
_RANGES = 5.0
_FAR_M = 30.0  # nothing is expected beyond
_CELLS = 10  # of the box that is carved, a side
_HELD = 0.65  # of the images in which a place lies, so many hold it


class Place(NamedTuple):
    """Where something is."""

    center: F64  # (3,) in the map [m]
    covariance: F64  # (3, 3)
    radius_m: float

    @property
    def sigma_m(self) -> float:
        """Deviation along the worst direction."""
        return largest_sigma(self.covariance)


def locate(seen: Sequence[Glimpse]) -> Place | None:
    """The place that lines of sight agree on best; None where they meet behind a camera."""
    rays = np.stack([g.ray for g in seen])
    origins = np.stack([g.origin for g in seen])
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    sigma_rad = np.array([_angle_sigma(g) for g in seen])
    ranges = np.array([g.distance_m for g in seen])
    known = np.isfinite(ranges)
    distance = np.where(known, ranges, np.nanmedian(ranges) if known.any() else 2.0)
    center, H = np.zeros(3), np.eye(3)
    spreads = np.array([g.spread_rad for g in seen])
    share = min(1.0, _RANGES / max(int(np.count_nonzero(known)), 1))
    belief = np.ones(len(seen))
    for _ in range(_PASSES):
        # A weak word for nearness keeps parallel lines from meeting nowhere.
        along = np.where(known, share / _range_variance(seen, distance), 1.0 / _FAR_M**2) * belief
        weights = belief / (sigma_rad * distance) ** 2
        M = weights[:, None, None] * across + along[:, None, None] * (np.eye(3) - across)
        middle = ranges + _FRONT * spreads * distance  # what is measured is its front
        at = origins + np.where(known, middle, distance)[:, None] * rays
        H = M.sum(axis=0)
        center = np.linalg.solve(H, np.einsum("nij,nj->i", M, at))
        distance = np.einsum("ni,ni->n", center - origins, rays)
        if distance.min() <= 0.02:
            return None
        if len(seen) >= _MANY:
            aside = np.linalg.norm(origins + distance[:, None] * rays - center, axis=1)
            belief = 1.0 / (1.0 + (aside / (sigma_rad * distance) / _DOUBTED) ** 2)
    whole = [g.is_whole for g in seen]
    radii = spreads * distance
    radius = np.median(radii[whole] if any(whole) else radii)
    return Place(center, np.asarray(np.linalg.inv(H), np.float64), float(radius))


def _angle_sigma(g: Glimpse) -> float:
    return (_ANGLE_RAD + _OF_SPREAD * g.spread_rad) * (1.0 if g.is_whole else _CUT)


def _range_variance(seen: Sequence[Glimpse], distance: F64) -> F64:
    """Variance of a measured distance as that of a thing's middle [m^2]."""
    sigma = np.array([g.distance_sigma_m for g in seen])
    half = np.array([g.spread_rad for g in seen]) * distance
    variance: F64 = np.where(np.isfinite(sigma), sigma**2 + (0.5 * half) ** 2, 1.0)
    return variance


def fits(g: Glimpse, place: Place, sizes: float = 1.8) -> float:
    """How well a line of sight points at a place, from 1 down; 0 or less where it does not."""
    away = place.center - g.origin
    distance = float(np.linalg.norm(away))
    if distance < 0.05:
        return 0.0
    cosine = float(np.clip(away @ g.ray / distance, -1.0, 1.0))
    unsure = np.sqrt(max(_across_variance(place, away / distance), 0.0)) / distance
    slack = 0.7 * (g.spread_rad if g.is_whole else g.reach_rad)
    limit = 0.01 + slack + 2.0 * min(unsure, 0.05)
    ratio = g.spread_rad * distance / max(place.radius_m, 1e-6)
    alike = 1.0 / sizes < ratio < sizes if g.is_whole else ratio < sizes
    if not alike or _is_at_another_depth(g, place, distance):
        return 0.0
    return float(1.0 - np.arccos(cosine) / limit)


def _across_variance(place: Place, direction: F64) -> float:
    """The larger variance of a place across a direction [m^2]."""
    across = np.eye(3) - np.outer(direction, direction)
    return float(np.linalg.eigvalsh(across @ place.covariance @ across)[-1])


def _is_at_another_depth(g: Glimpse, place: Place, distance: float) -> bool:
    if not np.isfinite(g.distance_m):
        return False
    off = abs(g.distance_m - distance)
    sure = g.distance_sigma_m + place.sigma_m
    return off > 3.0 * min(sure, distance) + 0.1 * distance + 2.0 * place.radius_m


def carve(seen: Sequence[Glimpse], place: Place) -> F64:
    """Points (n, 3) of the space that nearly all masks hold [m]; none where they do not agree."""
    distances = np.array([np.linalg.norm(place.center - g.origin) for g in seen])
    reach = 1.2 * float(np.median([g.reach_rad for g in seen] * distances))
    axis = (np.arange(_CELLS) + 0.5) / _CELLS * 2.0 - 1.0
    cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    coarse = place.center + reach * cube[np.linalg.norm(cube, axis=1) <= 1.0]
    kept: F64 = coarse[_are_held(seen, coarse)]
    if len(kept) == 0:
        return kept
    # Once more, finer, in the box of what is left.
    cell = 2.0 * reach / _CELLS
    low, high = kept.min(axis=0) - 0.5 * cell, kept.max(axis=0) + 0.5 * cell
    fine = 0.5 * (low + high) + 0.5 * (high - low) * cube
    fine_kept: F64 = fine[_are_held(seen, fine)]
    return fine_kept if len(fine_kept) else kept


def _are_held(seen: Sequence[Glimpse], points: F64) -> Bools:
    """Which points nearly all masks hold, of the images in which they lie."""
    held, shown = np.zeros(len(points)), np.zeros(len(points))
    for g in seen:
        pixels = g.camera.project(se3.transform(se3.inverse(g.T_map_cam), points))
        limit = np.array([g.camera.width, g.camera.height]) - 1.0
        shown += ((pixels >= 0.0) & (pixels <= limit)).all(axis=1)
        held += holds(g.mask, pixels)
    kept: Bools = (held >= _HELD * shown) & (held >= min(3, len(seen)))
    return kept
