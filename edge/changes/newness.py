# SPDX-License-Identifier: Apache-2.0
"""Whether the map says that a thing was not there."""

from collections.abc import Sequence

import numpy as np

from edge.changes.known import Known
from edge.changes.newcomer import CLEARLY, SURELY_HIDDEN, Newcomer
from edge.changes.newcomers import Newcomers
from edge.changes.place import carve
from edge.changes.space import Before, KnownSpace
from edge.config.changes import ChangesConfig
from edge.types import F64

_OF_HIDDEN = 0.1  # of the points that a thing hides, so many may be at its place: what it stands on
_TOUCH_M = 0.03  # so near to a part of an object is in it


class Newness:
    """Judges what is surely there. Owned by one thread."""

    def __init__(
        self,
        space: KnownSpace,
        known: Sequence[Known],
        labels: Sequence[int],
        newcomers: Newcomers,
        config: ChangesConfig,
    ) -> None:
        """`labels` are those of the `known` objects, by the model that looks now."""
        self._space, self._newcomers, self._config = space, newcomers, config
        self._known = list(zip(known, labels, strict=True))
        self._told: list[Newcomer] = []

    def is_new(self, newcomer: Newcomer) -> bool:
        """Whether to tell of it, which it then counts as; else it waits until more is known."""
        surely_hides = newcomer.hides >= SURELY_HIDDEN
        before = self._before(newcomer)
        # Masks of the map's images tell what stood there, and points that it hides, what did not.
        is_free = self._is_found_anywhere(newcomer) or newcomer.hides > 0
        if before.showing < self._config.free_views * (1 if is_free else 2) and not surely_hides:
            newcomer.wait(1)  # it may become known from elsewhere
            return False
        if (
            (before.seeing > self._config.weak_share * before.showing and not surely_hides)
            or before.points > max(self._config.free_points, _OF_HIDDEN * newcomer.hides)
            or newcomer.is_as_before(self._config.same_share)
        ):
            newcomer.wait(len(newcomer.glimpses))
            newcomer.is_of_map = True
        elif self._has_its_place(newcomer):
            newcomer.wait(CLEARLY)  # it may prove to be beside that
            newcomer.is_of_map = True
        else:
            newcomer.was_told = True
            self._told.append(newcomer)
        return newcomer.was_told

    def _before(self, newcomer: Newcomer) -> Before:
        """What images of the map say of its place."""
        config, place, hides = self._config, newcomer.place, self._hides(newcomer)
        assert place is not None
        # Where it hides what the map knows, or is found from everywhere, any image tells of it.
        anywhere = hides or self._is_found_anywhere(newcomer)
        like_deg = config.presence.view_angle_deg if anywhere else config.free_view_deg
        at = place.center, place.radius_m
        return self._space.views(*at, newcomer.cameras, newcomer.label, like_deg, hides=hides)

    def _hides(self, newcomer: Newcomer) -> bool:
        return newcomer.hides >= self._config.geometry.hidden_points

    def _is_found_anywhere(self, newcomer: Newcomer) -> bool:
        return newcomer.hit_rate(self._config) >= self._config.presence.highest_hit_rate

    def _has_its_place(self, newcomer: Newcomer) -> bool:
        """Whether a thing of the map, or one that was told as new, is where this one is."""
        place, hides = newcomer.place, self._hides(newcomer)
        assert place is not None
        for known, label in self._known:
            is_alike = label == newcomer.label
            # Space that masks carve is too large: what hides things was seen through there.
            if known.was_told or (hides and not is_alike):
                continue
            is_alike = is_alike and not newcomer.is_apart_from(known)
            touching = _TOUCH_M + is_alike * place.radius_m
            if np.linalg.norm(known.thing.points - place.center, axis=1).min() < touching:
                return True
        if self._newcomers.is_told(newcomer) or self._newcomers.is_part_of_told(newcomer):
            return True
        for told in self._told:
            middle, extent_m = space_of(told)
            reach = 0.5 * extent_m + (told.label == newcomer.label) * place.radius_m
            if (np.abs(place.center - middle) > reach).any() or newcomer.is_apart_from(told):
                continue
            if not self._newcomers.has_nearer(newcomer, middle, self._config):
                return True
        return False


def space_of(newcomer: Newcomer) -> tuple[F64, F64]:
    """Middle and extent (3,) of a new thing [m], as they are known now.

    What was two things under one mask at first is placed anew as their masks part.
    """
    place = newcomer.place
    assert place is not None
    points = carve(newcomer.glimpses, place)
    extent_m = np.ptp(points, axis=0) if len(points) else np.full(3, 2.0 * place.radius_m)
    return place.center, extent_m
