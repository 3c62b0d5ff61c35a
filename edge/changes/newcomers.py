# SPDX-License-Identifier: Apache-2.0
"""Things that the map does not know, followed over images until they are sure or forgotten."""

from collections.abc import Iterator, Sequence

import numpy as np

from edge.changes.cover import holds
from edge.changes.glimpse import Glimpse
from edge.changes.newcomer import Newcomer, distance_to
from edge.changes.place import fits, locate
from edge.changes.proof import Proof
from edge.config.changes import ChangesConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject
from edge.types import F32, F64, Look, Mat4

_BASELINE_RAD = 0.02  # between two lines of sight of which nothing else is known
_AGAIN = 2  # once may be chance
_BEFORE, _HIDDEN = 0.95, 0.3  # of a thing's depth; of its pixels, that none can miss
_PART, _LARGEST_WHOLE = 0.8, 10.0  # of a mask; times its size
_AROUND, _OF_BOTH = 1.5, 0.5  # times a thing's radius; of what shows another, a mask of both
_FORGET_NS = 20_000_000_000
_MARGIN_PX = 12.0
_MAX_FOLLOWED = 200
_KNOWN_GLIMPSES = 3
_SURE_FIT = 0.25  # a lonely line of sight may be of anything along it


class Newcomers:
    """All things that are followed. Owned by one thread."""

    def __init__(self, camera: CameraModel, config: ChangesConfig) -> None:
        self._camera, self._config = camera, config
        self._followed: list[Newcomer] = []

    def awaits(self, g: Glimpse) -> bool:
        """Whether a faint mask may be of what is followed, and has been called so."""
        return any(_fit_faint(g, n) > 0.0 for n in self._followed)

    def step(
        self,
        look: Look,
        seen: Sequence[Glimpse],
        covered: Sequence[Glimpse],
        proof: Proof,
        faint: Sequence[Glimpse] = (),
    ) -> None:
        """Take an image's masks that nothing explains; `covered` are all of its masks.

        Those that are `faint` begin nothing: they tell of what sure ones began.
        """
        self._followed = [n for n in self._followed if n.last_ns + _FORGET_NS > look.t_ns]
        found: set[int] = set()
        seen = [g for g in seen if not any(_is_part(g, other) for other in seen)]
        for g, chosen in zip(seen, self._assign(seen), strict=True):
            if chosen is None:
                if self._is_of_several(g):
                    continue
                chosen = Newcomer()
                self._followed.append(chosen)
            chosen.add(g, look, proof)
            found.add(id(chosen))
        for g in faint:
            waiting = [n for n in self._followed if id(n) not in found and _fit_faint(g, n) > 0.0]
            if waiting:
                chosen = max(waiting, key=lambda n: _fit_faint(g, n))
                chosen.add(g, look, proof)
                found.add(id(chosen))
        for newcomer in self._followed:
            if id(newcomer) not in found and self._must_show(newcomer, look, covered):
                newcomer.missed.append(look.T_map_cam[:3, 3])
        self._followed = self._followed[-_MAX_FOLLOWED:]

    def seen_at(self, t_ns: int) -> list[Newcomer]:
        """Those that the image of this time shows."""
        return [n for n in self._followed if n.last_ns == t_ns]

    def sure(self) -> list[Newcomer]:
        """Those that are sure and not told yet."""
        return [n for n in self._followed if not n.was_told and n.is_sure(self._config)]

    def has_nearer(self, newcomer: Newcomer, center: F64, config: ChangesConfig) -> bool:
        """Whether another thing of its kind, beside it, is surely there and nearer to a place.

        Models take two things for one from where one stands before the other.
        """
        own = newcomer.place
        assert own is not None
        return any(
            n.label == newcomer.label
            and not n.was_told
            and n.place is not None
            and distance_to(n.place, center) < distance_to(own, center)
            and distance_to(n.place, own.center) > n.place.radius_m + own.radius_m
            and n.presence(config).is_there
            for n in self._followed
        )

    def is_told(self, newcomer: Newcomer) -> bool:
        """Whether one of its kind was told that is now known to be at its very place."""
        own = newcomer.place
        assert own is not None
        return any(
            n.was_told
            and n.label == newcomer.label
            and n.place is not None
            and distance_to(n.place, own.center) < max(n.place.radius_m, own.radius_m)
            for n in self._followed
        )

    def is_part_of_told(self, newcomer: Newcomer) -> bool:
        """Whether its masks touch those of a larger thing that was told, from wherever one looks.

        Models name parts of things, too, as the pot of a plant.
        """
        own = newcomer.place
        assert own is not None
        return any(
            n.was_told
            and n.place is not None
            and n.place.radius_m > own.radius_m
            and newcomer.is_beside(n)
            for n in self._followed
        )

    def explain(self, g: Glimpse, thing: MapObject) -> bool:
        """Whether a mask is of something that was told as new, or that surely is beside a thing."""
        return self._is_apart(g, thing) or any(
            n.was_told and _may_be_of(g, n, thing) for n in self._followed
        )

    def are_apart(self, seen: Sequence[Glimpse], thing: MapObject, pixels: F32) -> list[Glimpse]:
        """Masks of what is new and surely beside a thing of the map, and not of both.

        `pixels` (n, 2) show the thing, if it is there.
        """
        return [
            g for g in seen if any(not _is_of_both(g, n, pixels) for n in self._apart(g, thing))
        ]

    def told(self, seen: Sequence[Glimpse], thing: MapObject) -> list[Glimpse]:
        """Masks of what was told as new, of another name than a thing of the map."""
        return [
            g
            for g in seen
            if g.label != thing.label
            and any(n.was_told and _may_be_of(g, n, thing) for n in self._followed)
        ]

    def _is_apart(self, g: Glimpse, thing: MapObject) -> bool:
        return any(True for _ in self._apart(g, thing))

    def _apart(self, g: Glimpse, thing: MapObject) -> Iterator[Newcomer]:
        """What a mask may be of that is surely beside a thing of the map."""
        for n in self._followed:
            if _may_be_of(g, n, thing) and n.is_apart(thing, self._config):
                yield n

    def may_hide(self, pixels: F32, depth_m: float, T_map_cam: Mat4) -> bool:
        """Whether something new that was seen again may stand before most of pixels (n, 2)."""
        for n in self._followed:
            if n.place is None or len(n.glimpses) < _AGAIN:
                continue
            local = se3.transform(se3.inverse(T_map_cam), n.place.center[None])
            if not 0.05 < local[0, 2] < _BEFORE * depth_m:
                continue
            reach = n.place.radius_m / local[0, 2] * self._camera.fx
            apart = np.linalg.norm(pixels - self._camera.project(local), axis=1)
            if (apart < reach).mean() > _HIDDEN:
                return True
        return False

    def _assign(self, seen: Sequence[Glimpse]) -> list[Newcomer | None]:
        pairs = [
            (-fit, i, n)
            for i, g in enumerate(seen)
            for n, newcomer in enumerate(self._followed)
            if (fit := _fit(g, newcomer)) > 0.0
        ]
        chosen: dict[int, int] = {}
        for _, i, n in sorted(pairs):
            if i not in chosen and n not in chosen.values():
                chosen[i] = n
        return [self._followed[chosen[i]] if i in chosen else None for i in range(len(seen))]

    def _is_of_several(self, g: Glimpse) -> bool:
        """Whether a mask lies over a thing of its kind that is followed, and does not fit it.

        Models take things behind one another for one: there is nothing at the middle of that.
        """
        places = [
            n.place.center
            for n in self._followed
            if n.place is not None and n.label == g.label and len(n.glimpses) >= _KNOWN_GLIMPSES
        ]
        if not places:
            return False
        local = se3.transform(se3.inverse(g.T_map_cam), np.stack(places))
        return bool(holds(g.mask, self._camera.project(local)).any())

    def _must_show(self, newcomer: Newcomer, look: Look, covered: Sequence[Glimpse]) -> bool:
        """Whether it is missed: in the image, nothing known before it, and no mask over it."""
        if newcomer.place is None:
            return False
        T_cam_map = se3.inverse(look.T_map_cam)
        local = se3.transform(T_cam_map, newcomer.place.center[None])
        pixel = self._camera.project(local)[0]
        limit = np.array([self._camera.width, self._camera.height]) - 1.0 - _MARGIN_PX
        if not ((pixel >= _MARGIN_PX) & (pixel <= limit)).all():
            return False
        if any(fits(g, newcomer.place, sizes=4.0) > -0.5 for g in covered):
            return False
        spread = newcomer.place.radius_m / local[0, 2] * self._camera.fx
        at = se3.transform(T_cam_map, look.surface)
        near = np.linalg.norm(self._camera.project(at) - pixel, axis=1) < max(spread, 8.0)
        return not bool((at[near, 2] < 0.85 * local[0, 2]).any())


def _is_part(g: Glimpse, other: Glimpse) -> bool:
    """Whether a mask lies within another: models name parts of things, too."""
    area = int(g.mask.inside.sum())
    if other is g or not area < other.mask.inside.sum() < _LARGEST_WHOLE * area:
        return False
    rows, columns = np.nonzero(g.mask.inside)
    at = np.column_stack([columns + g.mask.left, rows + g.mask.top]).astype(np.float32)
    return bool(holds(other.mask, at).mean() > _PART)


def _may_be_of(g: Glimpse, newcomer: Newcomer, thing: MapObject) -> bool:
    """Whether a mask is where a new thing is; of a known one's name, it must be the new one's, too.

    They may stand before one another.
    """
    if newcomer.place is None or fits(g, newcomer.place) <= 0.0:
        return False
    return g.label != thing.label or g.label in newcomer.names


def _is_of_both(g: Glimpse, newcomer: Newcomer, pixels: F32) -> bool:
    """Whether a mask holds most of a thing at pixels (n, 2), though a new one is beside it."""
    assert newcomer.place is not None
    local = se3.transform(se3.inverse(g.T_map_cam), newcomer.place.center[None])
    reach = _AROUND * newcomer.place.radius_m / local[0, 2] * g.camera.fx
    beside = np.linalg.norm(pixels - g.camera.project(local), axis=1) > reach
    return bool((holds(g.mask, pixels) & beside).mean() > _OF_BOTH)


def _fit_faint(g: Glimpse, newcomer: Newcomer) -> float:
    """How well a faint mask fits what is followed; 0 or less where it was never called so."""
    return _fit(g, newcomer) if g.label in newcomer.names else 0.0


def _fit(g: Glimpse, newcomer: Newcomer) -> float:
    if newcomer.place is not None:
        return fits(g, newcomer.place)
    first = newcomer.glimpses[0]
    if (
        g.label != first.label
        or float(np.arccos(np.clip(g.ray @ first.ray, -1.0, 1.0))) < _BASELINE_RAD
    ):
        return 0.0
    place = locate([first, g])
    if place is None:
        return 0.0
    fit = min(fits(first, place, 1.4), fits(g, place, 1.4))
    return 0.5 * fit if fit > _SURE_FIT else 0.0
