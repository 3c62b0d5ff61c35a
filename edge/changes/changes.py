# SPDX-License-Identifier: Apache-2.0
"""Compares what an image shows with what the map says that it must show."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from edge.changes.cover import find_held, is_solid, mask_of
from edge.changes.expect import expect
from edge.changes.explain import Shown, explains, is_beside, shown_part
from edge.changes.glimpse import Glimpse, glimpses
from edge.changes.hearing import hear, lay_bare
from edge.changes.hidden import MapViews
from edge.changes.in_view import InView
from edge.changes.known import Known, known_objects, shares_place
from edge.changes.newcomer import Newcomer
from edge.changes.newcomers import Newcomers
from edge.changes.newness import Newness, space_of
from edge.changes.proof import CONFIRMED, OPEN, Proof, Prover
from edge.changes.rest import rests
from edge.changes.sighting import sighting_of
from edge.changes.space import KnownSpace
from edge.changes.surroundings import Surroundings
from edge.changes.told import Told
from edge.config.changes import ChangesConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject, read_labels
from edge.tiles.reader import Map
from edge.types import F32, F64, I32, Bools, ChangeEvent, Evidence, Look, Mask

_LEAST_POINTS = 3  # of the map, under a mask, to tell that nothing is new there
_LEAST_SIDE_PX = 6  # of a new thing's mask: less is a cell of the model's grid, without a shape


class Changes:
    """Which objects of a map have come and gone. Owned by one thread."""

    def __init__(
        self, map_: Map, camera: CameraModel, names: Sequence[str], config: ChangesConfig
    ) -> None:
        """`names` are those of the classes of the model that looks now."""
        self._config, self._camera, self._names = config, camera, tuple(names)
        self._prover = Prover(map_, camera, config.proof)
        self._labels = read_labels(map_)
        self._known: list[Known] = []
        self._views: dict[int, MapViews] = {}  # by the id of a known object
        if self._labels is not None:
            looked_at = self._labels.looked_at
            self._known = known_objects(map_, self._labels, config)
            self._views = {
                id(k): MapViews(k, map_, looked_at, config.presence) for k in self._known
            }
        self._in_view = InView([known.thing for known in self._known], camera)
        self._on_objects = np.concatenate([np.empty(0, np.int32), *(k.points for k in self._known)])
        self._around = Surroundings(map_, camera, config.presence.depth_tolerance)
        self._new = Newcomers(camera, config)
        self._told = Told(config.moved_m)
        self._newness: Newness | None = None
        if self._labels is not None:
            space = KnownSpace(map_, self._labels, config)
            names = [self._map_name(known.thing) for known in self._known]
            kinds = [self._names.index(n) if n in self._names else -1 for n in names]
            self._newness = Newness(space, self._known, kinds, self._new, config)

    @property
    def events(self) -> list[ChangeEvent]:
        """All that was told, in order."""
        return self._told.events

    def step(self, look: Look) -> list[ChangeEvent]:
        """What has become sure with this image."""
        if look.detections is None or self._labels is None:
            return []
        self._around.look(look)
        ranger = self._around.range_of
        seen = glimpses(look.detections, look.T_map_cam, self._camera, ranger)
        awaited = [g for g in self._faint(look) if self._new.awaits(g)]
        matters = self._matter([g.mask for g in (*seen, *awaited)])
        proof = self._prover.prove(look.image, look.T_map_cam, matters, alone=True)
        shown = self._look_for_known(look, seen, proof)
        unknown = [g for g in (*seen, *awaited) if not self._is_known(g, shown)]
        unexplained = [
            g
            for g in (*unknown, *rests(seen, shown, ranger))
            if min(g.mask.inside.shape) >= _LEAST_SIDE_PX
            and is_solid(g.mask)
            and self._counts(self._names[g.label])
            and not self._is_as_before(g, proof)
        ]
        sure = [g for g in unexplained if not g.is_faint]
        weak = [g for g in unexplained if g.is_faint]
        self._new.step(look, sure, (*seen, *awaited), proof, weak)
        self._part(look, seen, shown)
        told = [self._tell_gone(known, look) for known in self._gone()]
        told += self._tell_parts(look)
        return told + [e for n in self._new.sure() if (e := self._tell_new(n, look)) is not None]

    def _faint(self, look: Look) -> list[Glimpse]:
        if look.faint is None:
            return []
        ranger = self._around.range_of
        return glimpses(look.faint, look.T_map_cam, self._camera, ranger, are_faint=True)

    def _matter(self, masks: Sequence[Mask]) -> Callable[[I32, F32], Bools]:
        """Points that matter: on objects of the map, and under masks."""

        def matters(points: I32, pixels: F32) -> Bools:
            chosen: Bools = np.isin(points, self._on_objects)
            return chosen | find_held(masks, pixels)

        return matters

    # --- objects of the map ---

    def _look_for_known(self, look: Look, seen: Sequence[Glimpse], proof: Proof) -> list[Shown]:
        """Let each object that must be seen speak; all objects that are inside the image."""
        assert look.detections is not None
        shown = []
        for known in (self._known[i] for i in self._in_view.of(look.T_map_cam)):
            found = expect(
                known.expected,
                look.T_map_cam,
                self._camera,
                self._around.nearest_before,
                self._config.presence,
            )
            if found.holds and self._views[id(known)].was_hidden_from(look.T_map_cam[:3, 3]):
                found = replace(found, reason="hidden")
            if (part := shown_part(known, found, self._camera)) is not None:
                shown.append(part)
        for part in shown:
            if part.found.holds:
                same = (part.known.thing, *part.known.twins)
                others = [o for o in shown if o.known.thing not in same]
                sighting, found = sighting_of(part, seen, others, self._new, self._config.presence)
                if sighting == "missed":
                    near = [g for g in seen if is_beside(part, g)]
                    if any(
                        not (self._is_known(g, others) or self._new.explain(g, part.known.thing))
                        for g in near
                    ) or self._is_behind_new(part, look):
                        sighting = "unclear"
                hear(part.known, found, look, proof, sighting, self._camera)
                lay_bare(part, found, look, seen, self._config.free_view_deg)
        return shown

    def _is_behind_new(self, part: Shown, look: Look) -> bool:
        found = part.found
        away = part.known.thing.center - look.T_map_cam[:3, 3]
        depth_m = float(look.T_map_cam[:3, 2] @ away)
        return self._new.may_hide(found.pixels[found.visible], depth_m, look.T_map_cam)

    def _gone(self) -> Iterator[Known]:
        """Those to be told, one by one: of twins that have gone, the first tells for all."""
        for known in self._known:
            if known.was_told or not known.is_gone:
                continue
            if self._is_there_as_twin(known) and not known.is_carved_away:
                continue
            if self._counts(self._map_name(known.thing)):
                known.was_told = any(
                    k.was_told and (k.thing in known.twins or shares_place(k, known))
                    for k in self._known
                )
                if not known.was_told:
                    yield known

    def _is_there_as_twin(self, known: Known) -> bool:
        """Whether the same thing under another mask was rather seen than missed."""
        return any(
            k.thing in known.twins and k.presence.n_for > 0 and k.presence.log_odds > 0.0
            for k in self._known
        )

    def _tell_gone(self, known: Known, look: Look) -> ChangeEvent:
        known.was_told = True
        presence, thing = known.presence, known.usual
        says = presence.log_odds, presence.n_against
        return self._told.tell(
            "removed",
            self._map_name(thing),
            (thing.center, thing.extent_m),
            known.evidence,
            says,
            look,
        )

    def _tell_parts(self, look: Look) -> Iterator[ChangeEvent]:
        """Of what was one thing under the masks of the map: one that is gone, another is there."""
        for known in self._known:
            lost = None if known.was_told else known.lost_part
            if lost is None or not self._counts(name := self._map_name(known.thing)):
                continue
            points = known.expected.points[lost]
            n_bare = known.carving_alike.n_bare(lost)
            log_odds = (1 - n_bare) * self._config.presence.viewpoint_log_odds
            evidence = [self._with_mask(each, points) for each in known.evidence_alike]
            self._keep(known, ~lost)
            # From some sides it had a mask of its own: that one has gone with it.
            itself = [k for k in self._known if k is not known and _is_within(k, known, points)]
            was_told = any(k.was_told for k in itself)
            for each in itself:
                each.was_told = True
            if not was_told:
                space = points.mean(axis=0), np.ptp(points, axis=0)
                yield self._told.tell("removed", name, space, evidence, (log_odds, n_bare), look)

    def _keep(self, known: Known, rest: Bools) -> None:
        """Let an object be the rest of itself, for its twins as well."""
        before = known.thing
        known.keep(rest)
        for each in self._known:
            each.twins = tuple(known.thing if t is before else t for t in each.twins)

    def _with_mask(self, evidence: Evidence, points: F64) -> Evidence:
        """With the outline of places (n, 3), if that is in the image."""
        local = se3.transform(se3.inverse(evidence.T_map_cam), points)
        pixels = self._camera.project(local)
        shown = pixels[np.isfinite(pixels).all(axis=1)].astype(np.float32)
        return replace(evidence, mask=mask_of(shown, self._camera))

    # --- what the map does not know ---

    def _is_known(self, g: Glimpse, shown: Sequence[Shown]) -> bool:
        """Whether an object of the map is behind a mask."""
        return any(not part.known.was_told and explains(part, g) for part in shown)

    def _part(self, look: Look, seen: Sequence[Glimpse], shown: Sequence[Shown]) -> None:
        """Note what is new and which object of its name the image shows under another mask."""
        for newcomer in self._new.seen_at(look.t_ns):
            own, label = newcomer.glimpses[-1], newcomer.label
            others = [g for g in seen if g is not own and g.label == label]
            for part in shown:
                if self._map_name(part.known.thing) == self._names[label]:
                    for g in others:
                        if explains(part, g):
                            newcomer.see_beside(part.known, g.mask)

    def _is_as_before(self, g: Glimpse, proof: Proof) -> bool:
        """Whether the image shows the map's own points under a mask."""
        depth_m = g.distance_m * float(g.T_map_cam[:3, 2] @ g.ray)
        verdict = proof.verdict[proof.behind(g.mask, depth_m)]
        tested = (verdict != OPEN).sum()
        same = (verdict == CONFIRMED).sum()
        return bool(same >= _LEAST_POINTS and same >= self._config.same_share * tested)

    def _tell_new(self, newcomer: Newcomer, look: Look) -> ChangeEvent | None:
        """The event of a new thing; None where the map does not say that it was not there."""
        if self._newness is None or not self._newness.is_new(newcomer):
            return None
        presence = newcomer.presence(self._config)
        middle, extent_m = space_of(newcomer)
        says = presence.log_odds, presence.n_for
        name = self._names[newcomer.label]
        return self._told.tell("added", name, (middle, extent_m), newcomer.evidence, says, look)

    # --- what is common ---

    def _counts(self, name: str) -> bool:
        config = self._config
        return name not in config.ignored and (not config.movable or name in config.movable)

    def _map_name(self, thing: MapObject) -> str:
        assert self._labels is not None
        return self._labels.names[thing.label]


def _is_within(known: Known, other: Known, points: F64) -> bool:
    """Whether an object is in the space (n, 3) of a part of another of its kind."""
    center = known.thing.center
    inside = (points.min(axis=0) <= center) & (center <= points.max(axis=0))
    return known.thing.label == other.thing.label and bool(inside.all())
