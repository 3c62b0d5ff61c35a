# SPDX-License-Identifier: Apache-2.0
"""One thing that the map does not know."""

from collections import Counter

import numpy as np

from edge.changes.cover import grown, holds
from edge.changes.glimpse import Glimpse
from edge.changes.known import Known
from edge.changes.place import Place, locate
from edge.changes.presence import Presence
from edge.changes.proof import CONFIRMED, CONTRADICTED, Proof
from edge.config.changes import ChangesConfig
from edge.tiles.labels import MapObject
from edge.types import F64, Evidence, Look, Mask

_HIT_RATE = 0.7  # of a model that has found it several times
_OF_FAINT = 0.5  # as much as a sure mask, says a faint one
_OWN_POINTS = 2  # of the map, that are of the thing
_DEPTH_SHARE = 0.02  # of a depth, that it is wrong
_AGAIN = 2  # once may be chance
_CUT = 10  # times as large must be what the image's border cuts: its size and middle are unknown
_SHINING_THROUGH = 0.1  # of the points that a thing hides, that may seem to show
_OF_CUT = 0.25  # as much as of a whole one, says what the border cuts
_OF_RADIUS = 0.4  # of a large thing, the middle is less sure than its place
SURELY_HIDDEN, _OF_RADIUS_THEN = 10, 0.6  # points of the map, before which surely something is new
_BESIDE_PX, _OFTEN_BESIDE = 4, 0.8  # between masks of parts of one thing; of the images of both
CLEARLY = 6  # images
_MAX_GLIMPSES = 60  # of one thing; more say nothing new


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
        self.is_of_map = False  # its images saw something there
        self._wanted = 0  # masks, before it is judged again
        # How often points of the map that it hides showed under its masks, and did not, and how
        # often points at its own place did.
        self._same: Counter[int] = Counter()
        self._other: Counter[int] = Counter()
        self._own: Counter[int] = Counter()
        self._apart: Counter[int] = Counter()  # images, by the id of an object of the map

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
        same, other, own = _again(self._same), _again(self._other), _again(self._own)
        is_there = own >= _OWN_POINTS and own >= share * (own + other)
        return is_there or (same >= 1 and same >= share * (same + other))

    @property
    def hides(self) -> int:
        """How many points of the map it hides, that were seen through its place from about here.

        0 where some of them show.
        """
        same, other = _again(self._same), _again(self._other)
        return other if _again(self._own) == 0 and same <= _SHINING_THROUGH * other else 0

    def hit_rate(self, config: ChangesConfig) -> float:
        """From how many of the viewpoints that must show it the model finds it, rather too low."""
        presence = self.presence(config)
        return presence.n_for / (presence.n_for + presence.n_against + 1.0)

    @property
    def cameras(self) -> F64:
        """Where it was seen from (n, 3)."""
        return np.stack([g.origin for g in self.glimpses])

    def presence(self, config: ChangesConfig) -> Presence:
        """What its views add up to, as seen from where it is now known to be."""
        presence = Presence(config.presence, config.presence.new_log_odds)
        if self.place is not None:
            for g in self.glimpses:
                weight = _OF_FAINT if g.is_faint else 1.0
                away = distance_to(self.place, g.origin)
                presence.add("seen", g.origin, away, _HIT_RATE, weight)
            for origin in self.missed:
                presence.add("missed", origin, distance_to(self.place, origin), _HIT_RATE)
        return presence

    def wait(self, more: int) -> None:
        """Do not be sure before so many more masks place it better."""
        self._wanted = self.names.total() + more

    def is_apart(self, thing: MapObject, config: ChangesConfig) -> bool:
        """Whether it is surely there, and surely not where an object of the map is."""
        if self.is_of_map or self.place is None or not self.presence(config).is_there:
            return False
        apart = float(np.linalg.norm(self.place.center - thing.center))
        # Space that few masks carve is too long along their lines of sight, and nowhere else.
        halves = self.place.radius_m + 0.5 * float(thing.extent_m.min())
        return apart > halves + 2.0 * self.place.sigma_m

    def is_beside(self, other: "Newcomer") -> bool:
        """Whether its masks touch the other's in nearly all images that show both."""
        touching, apart = self._touches(other)
        return touching >= max(_OFTEN_BESIDE * (touching + apart), _AGAIN)

    def is_apart_from(self, other: "Newcomer | Known") -> bool:
        """Whether images show it and the other, each under a mask of its own: they are two."""
        if isinstance(other, Known):
            return self._apart[id(other)] >= CLEARLY
        return self._touches(other)[1] >= CLEARLY

    def see_beside(self, known: Known, mask: Mask) -> None:
        """Take a mask of an object of the map from the image that the last one of it is of."""
        self._apart[id(known)] += not _touch(self.glimpses[-1].mask, mask)

    def _touches(self, other: "Newcomer") -> tuple[int, int]:
        """In how many images its masks touch the other's, and do not."""
        theirs = {e.t_ns: e.mask for e in other.evidence if e.mask is not None}
        both = [
            (e.mask, theirs[e.t_ns])
            for e in self.evidence
            if e.mask is not None and e.t_ns in theirs
        ]
        touching = sum(_touch(*masks) for masks in both)
        return touching, len(both) - touching

    def is_sure(self, config: ChangesConfig) -> bool:
        """Whether it is surely there, and surely at its place."""
        if self.place is None or self.names.total() < self._wanted:
            return False
        if not self.presence(config).is_there:
            return False
        if sum(not g.is_faint for g in self.glimpses) < _AGAIN:
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
        share = _OF_RADIUS_THEN if self.hides >= SURELY_HIDDEN else _OF_RADIUS
        return self.place.sigma_m < max(limit, share * self.place.radius_m)


def distance_to(place: Place, origin: F64) -> float:
    """From a camera's place (3,) to that of a thing [m]."""
    return float(np.linalg.norm(origin - place.center))


def _touch(one: Mask, other: Mask) -> bool:
    """Whether masks are side by side, or over one another."""
    near = grown(one, _BESIDE_PX)
    rows, columns = np.nonzero(near.inside)
    at = np.column_stack([columns + near.left, rows + near.top]).astype(np.float32)
    return bool(holds(other, at).any())


def _again(counts: Counter[int]) -> int:
    return sum(times >= _AGAIN for times in counts.values())
