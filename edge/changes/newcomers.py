# SPDX-License-Identifier: Apache-2.0
"""Things that the map does not know, followed over images until they are sure or forgotten."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from edge.changes.cover import holds
from edge.changes.glimpse import Glimpse
from edge.changes.place import Place, fits, locate
from edge.changes.presence import Presence
from edge.changes.proof import CONFIRMED, CONTRADICTED, Proof
from edge.config.changes import ChangesConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject
from edge.types import F32, F64, Evidence, Look, Mat4

_BASELINE_RAD = 0.02  # between two lines of sight of which nothing else is known
_HIT_RATE = 0.7  # of a model that has found it several times
_OWN_POINTS = 2  # of the map, that are of the thing
_DEPTH_SHARE = 0.02  # of a depth, that it is wrong
_AGAIN = 2  # once may be chance
_BEFORE, _HIDDEN = 0.95, 0.3  # of a thing's depth; of its pixels, that none can miss
_CUT = 10  # times as large must be what the image's border cuts: its size and middle are unknown
_SHINING_THROUGH = 0.05  # of the points that a thing hides, that may seem to show
_OF_CUT = 0.25  # as much as of a whole one, says what the border cuts
_PART, _LARGEST_WHOLE = 0.8, 10.0  # of a mask; times its size
_OF_RADIUS = 0.4  # of a large thing, the middle is less sure than its place
_FORGET_NS = 20_000_000_000
_MARGIN_PX = 12.0
_MAX_GLIMPSES = 60  # of one thing; more say nothing new
_MAX_FOLLOWED = 200
_KNOWN_GLIMPSES = 3
_SURE_FIT = 0.25  # a lonely line of sight may be of anything along it


class Newcomer:
    """One thing, as far as it is known."""

    def __init__(self) -> None:
        self.glimpses: list[Glimpse] = []
        self.evidence: list[Evidence] = []
        self.missed: list[F64] = []  # places (3,) of cameras that must have shown it
        self.names: Counter[int] = Counter()
        self.place: Place | None = None
        self.last_ns = 0
        self.was_told = False
        self._wanted = 0  # masks, before it is judged again
        # How often points of the map that it hides showed under its masks, and did not, and how
        # often points at its own place did.
        self._same: Counter[int] = Counter()
        self._other: Counter[int] = Counter()
        self._own: Counter[int] = Counter()

    def add(self, glimpse: Glimpse, look: Look, proof: Proof) -> None:
        """Take a mask that is of it, and what the image says of the map's points under it."""
        self._compare(glimpse, proof)
        self.names[glimpse.label] += 1
        self.last_ns = look.t_ns
        self.glimpses.append(glimpse)
        self.evidence.append(Evidence(look.index, look.t_ns, look.T_map_cam, glimpse.mask))
        if len(self.glimpses) > _MAX_GLIMPSES:
            self._drop_one()
        if len(self.glimpses) > 1 or np.isfinite(glimpse.distance_m):
            self.place = locate(self.glimpses)

    def _drop_one(self) -> None:
        """Forget the one whose camera was nearest to that of the one before: it says least.

        But the last: an event shows it.
        """
        steps = np.linalg.norm(np.diff(self.cameras[:-1], axis=0), axis=1)
        whole = np.array([g.is_whole for g in self.glimpses[1:-1]])
        i = 1 + int(np.where(whole, steps, _OF_CUT * steps).argmin())
        del self.glimpses[i], self.evidence[i]

    def _compare(self, glimpse: Glimpse, proof: Proof) -> None:
        """Count what the image says of the map's points under a mask."""
        depth = self._depth(glimpse)
        under = proof.behind(glimpse.mask, depth)
        self._same.update(proof.points[under[proof.verdict[under] == CONFIRMED]].tolist())
        self._other.update(proof.points[under[proof.verdict[under] == CONTRADICTED]].tolist())
        at = proof.at(glimpse.mask, depth, depth * (0.5 * glimpse.spread_rad + _DEPTH_SHARE))
        self._own.update(proof.points[at[proof.verdict[at] == CONFIRMED]].tolist())

    def _depth(self, glimpse: Glimpse) -> float:
        """How far along the camera's axis it is; NaN where unknown."""
        ahead = glimpse.T_map_cam[:3, 2]
        if self.place is not None:
            return float(ahead @ (self.place.center - glimpse.origin))
        return glimpse.distance_m * float(ahead @ glimpse.ray)

    @property
    def label(self) -> int:
        """Its usual class."""
        return min(self.names, key=lambda name: (-self.names[name], name))

    def is_as_before(self, share: float) -> bool:
        """Whether points of the map show under its masks again and again, as if it hid nothing."""
        same, other = _again(self._same), _again(self._other)
        return _again(self._own) >= _OWN_POINTS or (same >= 1 and same >= share * (same + other))

    @property
    def hides(self) -> int:
        """How many points of the map it hides, that were seen through its place from about here.

        0 where some of them show.
        """
        same, other = _again(self._same), _again(self._other)
        return other if _again(self._own) == 0 and same <= _SHINING_THROUGH * other else 0

    @property
    def cameras(self) -> F64:
        """Where it was seen from (n, 3)."""
        return np.stack([g.origin for g in self.glimpses])

    def presence(self, config: ChangesConfig) -> Presence:
        """What its views add up to, as seen from where it is now known to be."""
        presence = Presence(config.presence, config.presence.new_log_odds)
        if self.place is not None:
            for g in self.glimpses:
                presence.add("seen", g.origin, _distance(self.place, g.origin), _HIT_RATE)
            for origin in self.missed:
                presence.add("missed", origin, _distance(self.place, origin), _HIT_RATE)
        return presence

    def wait(self, more: int) -> None:
        """Do not be sure before so many more masks place it better."""
        self._wanted = self.names.total() + more

    def is_apart(self, thing: MapObject, config: ChangesConfig) -> bool:
        """Whether it is surely there, and surely not where an object of the map is."""
        if self.place is None or not self.presence(config).is_there:
            return False
        apart = float(np.linalg.norm(self.place.center - thing.center))
        # Space that few masks carve is too long along their lines of sight, and nowhere else.
        halves = self.place.radius_m + 0.5 * float(thing.extent_m.min())
        return apart > halves + 2.0 * self.place.sigma_m

    def is_sure(self, config: ChangesConfig) -> bool:
        """Whether it is surely there, and surely at its place."""
        if self.place is None or self.names.total() < self._wanted:
            return False
        if not self.presence(config).is_there:
            return False
        least = config.presence.there_px
        clear = sum(
            np.count_nonzero(g.mask.inside) >= (least if g.is_whole else _CUT * least)
            for g in self.glimpses
        )
        if clear < config.presence.there_viewpoints:
            return False
        nearest = float(np.linalg.norm(self.cameras - self.place.center, axis=1).min())
        limit = config.place_sigma_m + config.place_share * nearest
        return self.place.sigma_m < max(limit, _OF_RADIUS * self.place.radius_m)


class Newcomers:
    """All things that are followed. Owned by one thread."""

    def __init__(self, camera: CameraModel, config: ChangesConfig) -> None:
        self._camera, self._config = camera, config
        self._followed: list[Newcomer] = []

    def step(
        self, look: Look, seen: Sequence[Glimpse], covered: Sequence[Glimpse], proof: Proof
    ) -> None:
        """Take an image's masks that nothing explains; `covered` are all of its masks."""
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
        for newcomer in self._followed:
            if id(newcomer) not in found and self._must_show(newcomer, look, covered):
                newcomer.missed.append(look.T_map_cam[:3, 3])
        self._followed = self._followed[-_MAX_FOLLOWED:]

    def sure(self) -> list[Newcomer]:
        """Those that are sure and not told yet."""
        return [n for n in self._followed if not n.was_told and n.is_sure(self._config)]

    def explain(self, g: Glimpse, thing: MapObject) -> bool:
        """Whether a mask is of something that was told as new, or that surely is beside a thing."""
        return any(
            n.place is not None
            and fits(g, n.place) > 0.0
            and (n.was_told or n.is_apart(thing, self._config))
            for n in self._followed
        )

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


def _again(counts: Counter[int]) -> int:
    return sum(times >= _AGAIN for times in counts.values())


def _distance(place: Place, origin: F64) -> float:
    return float(np.linalg.norm(origin - place.center))


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
