# SPDX-License-Identifier: Apache-2.0
"""Compares what an image shows with what the map says that it must show."""

from collections.abc import Callable, Sequence

import numpy as np

from edge.changes.cover import find_cover, grown, holds, mask_of
from edge.changes.expect import Expectation, expect, sight
from edge.changes.glimpse import Glimpse, Ranger, glimpses
from edge.changes.known import Known, known_objects
from edge.changes.newcomers import Newcomer, Newcomers
from edge.changes.place import carve
from edge.changes.proof import CONFIRMED, CONTRADICTED, OPEN, Proof, Prover
from edge.changes.space import KnownSpace
from edge.config.changes import ChangesConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject, read_labels
from edge.tiles.reader import Map
from edge.types import F32, F64, I32, Bools, ChangeEvent, Evidence, Look, Mask

_MAX_EVIDENCE = 60
_MANY_DEPTHS = 3
_DEPTH_SIGMA = 0.05
_OUTLINE_PX = 4
_SURFACE_PX = 14.0  # a depth tells what is about so far around it
_LEAST_POINTS = 3  # of the map, under a mask, to tell that nothing is new there
_SURE_POINTS = 4  # of an object, that show that it is there
_EXPLAINED = 0.3  # of an object's space, under a mask of like size
_ALIKE_SIZE = 4.0


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
        self._space: KnownSpace | None = None
        if self._labels is not None:
            self._known = known_objects(map_, self._labels, config)
            self._space = KnownSpace(map_, self._labels, config.free_view_deg)
        self._on_objects = np.concatenate([np.empty(0, np.int32), *(k.points for k in self._known)])
        self._new = Newcomers(camera, config)
        self.events: list[ChangeEvent] = []

    def step(self, look: Look) -> list[ChangeEvent]:
        """What has become sure with this image."""
        proof = self._prover.prove(look.image, look.T_map_cam, self._preference(look))
        told: list[ChangeEvent] = []
        if look.detections is not None and self._labels is not None:
            seen = glimpses(look.detections, look.T_map_cam, self._camera, self._ranger(look))
            expected = self._look_for_known(look, proof)
            unexplained = [
                g
                for g in seen
                if self._counts(self._names[g.label])
                and not self._is_known(g, expected)
                and not self._is_as_before(g, proof)
            ]
            self._new.step(look, unexplained, seen, proof)
            told += [self._tell_gone(known, look) for known in self._gone()]
            told += [e for n in self._new.sure() if (e := self._tell_new(n, look)) is not None]
        return told

    def _preference(self, look: Look) -> Callable[[I32, F32], Bools]:
        """Points that matter: on objects of the map, and under masks."""

        def matters(points: I32, pixels: F32) -> Bools:
            chosen: Bools = np.isin(points, self._on_objects)
            if look.detections is not None:
                chosen |= find_cover(look.detections, pixels) >= 0
            return chosen

        return matters

    # --- objects of the map ---

    def _look_for_known(self, look: Look, proof: Proof) -> list[tuple[Known, Expectation]]:
        """Let each object that must be seen speak; all objects that are inside the image."""
        assert look.detections is not None
        shown = []
        for known in self._known:
            surface = self._surface_over(known.thing.points, look)
            found = expect(
                known.thing, look.T_map_cam, self._camera, surface, self._config.presence
            )
            if found.reason == "outside":
                continue
            shown.append((known, found))
            if found.holds:
                self._hear(known, found, look, proof)
        return shown

    def _hear(self, known: Known, found: Expectation, look: Look, proof: Proof) -> None:
        assert look.detections is not None
        sighting = sight(found, look.detections, self._config.presence)
        if sighting == "missed":
            known.hear_points(proof.points, proof.verdict)
            verdict = proof.verdict[np.isin(proof.points, known.points)]
            same, other = (verdict == CONFIRMED).sum(), (verdict == CONTRADICTED).sum()
            if same >= _SURE_POINTS and same > other:
                sighting = "seen"  # the model blinked: the image shows its very points
            elif same >= _LEAST_POINTS and same >= other:
                sighting = "unclear"
        origin = look.T_map_cam[:3, 3]
        distance = float(np.linalg.norm(origin - known.thing.center))
        known.presence.add(sighting, origin, distance, found.hit_rate)
        if sighting == "missed" and len(known.evidence) < _MAX_EVIDENCE:
            mask = mask_of(found.pixels[found.visible], self._camera)
            known.evidence.append(Evidence(look.index, look.t_ns, look.T_map_cam, mask))

    def _gone(self) -> list[Known]:
        return [
            known
            for known in self._known
            if not known.was_told
            and known.is_gone
            and self._counts(self._map_name(known.thing))
            and not self._is_told(known)
        ]

    def _is_told(self, known: Known) -> bool:
        """Whether it is a part of what is gone anyway, or the same under another mask."""
        thing = known.thing
        for other in self._known:
            if other.was_told and other.thing.label == thing.label:
                size = np.linalg.norm(thing.extent_m) + np.linalg.norm(other.thing.extent_m)
                if np.linalg.norm(thing.center - other.thing.center) < 0.25 * size:
                    known.was_told = True
        return known.was_told

    def _tell_gone(self, known: Known, look: Look) -> ChangeEvent:
        known.was_told = True
        presence, thing = known.presence, known.thing
        return self._tell(
            ChangeEvent(
                id=len(self.events),
                t_ns=look.t_ns,
                kind="removed",
                label=self._map_name(thing),
                score=_probability(-presence.log_odds),
                center_map_m=thing.center,
                extent_m=thing.extent_m,
                n_views=presence.n_against,
                log_odds=presence.log_odds,
                source="model",
                evidence=tuple(known.evidence),
                partner=self._partner("added", self._map_name(thing), thing.center),
                image=look.image,
            )
        )

    # --- what the map does not know ---

    def _is_known(self, g: Glimpse, expected: list[tuple[Known, Expectation]]) -> bool:
        """Whether an object of the map is behind a mask."""
        area = float(g.mask.inside.sum())
        for known, found in expected:
            if known.was_told:
                continue
            pixels = found.pixels[np.isfinite(found.pixels).all(axis=1)]
            if len(pixels) == 0 or holds(g.mask, pixels).mean() < _EXPLAINED:
                continue
            sides = np.maximum(np.ptp(pixels, axis=0), 3.0)
            if area < _ALIKE_SIZE * float(sides.prod()):
                return True
        return False

    def _is_as_before(self, g: Glimpse, proof: Proof) -> bool:
        """Whether the image shows the map's own points under a mask."""
        depth_m = g.distance_m * float(g.T_map_cam[:3, 2] @ g.ray)
        verdict = proof.verdict[proof.behind(g.mask, depth_m)]
        tested = (verdict != OPEN).sum()
        same = (verdict == CONFIRMED).sum()
        return bool(same >= _LEAST_POINTS and same >= self._config.same_share * tested)

    def _tell_new(self, newcomer: Newcomer, look: Look) -> ChangeEvent | None:
        """The event of a new thing; None where the map does not say that it was not there."""
        place = newcomer.place
        assert place is not None
        assert self._space is not None
        before = self._space.views(place.center, place.radius_m, newcomer.cameras)
        if before.showing < self._config.free_views:
            return None  # may become known from elsewhere
        newcomer.was_told = True
        if before.seeing > self._config.weak_share * before.showing:
            return None
        is_same = newcomer.is_as_before(self._config.same_share)
        if before.points > self._config.free_points or is_same:
            return None
        points = carve(newcomer.glimpses, place)
        presence = newcomer.presence(self._config)
        return self._tell(
            ChangeEvent(
                id=len(self.events),
                t_ns=look.t_ns,
                kind="added",
                label=self._names[newcomer.label],
                score=_probability(presence.log_odds),
                center_map_m=place.center,
                extent_m=np.ptp(points, axis=0) if len(points) else np.full(3, 2 * place.radius_m),
                n_views=presence.n_for,
                log_odds=presence.log_odds,
                source="model",
                evidence=tuple(newcomer.evidence),
                partner=self._partner("removed", self._names[newcomer.label], place.center),
                image=look.image,
            )
        )

    def _partner(self, kind: str, label: str, center: F64) -> int | None:
        """The nearest event of the other kind about a thing of this label: it was moved."""
        taken = {event.partner for event in self.events}
        near = [
            (float(np.linalg.norm(event.center_map_m - center)), event.id)
            for event in self.events
            if (event.kind, event.label) == (kind, label) and event.id not in taken
        ]
        distance, number = min(near, default=(np.inf, -1))
        return number if distance <= self._config.moved_m else None

    def _tell(self, event: ChangeEvent) -> ChangeEvent:
        self.events.append(event)
        return event

    # --- what is common ---

    def _counts(self, name: str) -> bool:
        config = self._config
        return name not in config.ignored and (not config.movable or name in config.movable)

    def _map_name(self, thing: MapObject) -> str:
        assert self._labels is not None
        return self._labels.names[thing.label]

    def _surface_over(self, points: F64, look: Look) -> F64:
        """Depth (n,) of the nearest thing measured about where points lie; NaN where none is."""
        nothing = np.full(len(points), np.nan)
        T_cam_map = se3.inverse(look.T_map_cam)
        at = se3.transform(T_cam_map, look.surface)
        pixels, there = self._camera.project(at), se3.transform(T_cam_map, points)
        own = self._camera.project(there)
        if len(at) == 0 or not np.isfinite(own).all(axis=1).any():
            return nothing
        low, high = np.nanmin(own, axis=0) - _SURFACE_PX, np.nanmax(own, axis=0) + _SURFACE_PX
        near = ((pixels >= low) & (pixels <= high)).all(axis=1)
        if not near.any():
            return nothing
        apart = np.linalg.norm(own[:, None] - pixels[near][None], axis=2)
        depth = np.where(apart < _SURFACE_PX, at[near, 2], np.inf).min(axis=1)
        surface: F64 = np.where(np.isfinite(depth), depth, np.nan)
        return surface

    def _ranger(self, look: Look) -> Ranger:
        at = se3.transform(se3.inverse(look.T_map_cam), look.surface)
        pixels = self._camera.project(at)

        def ranger(mask: Mask) -> tuple[float, float]:
            depth = at[holds(mask, pixels), 2]
            if len(depth) < _MANY_DEPTHS:  # of what is plain, its outline is measured
                depth = at[holds(grown(mask, _OUTLINE_PX), pixels), 2]
            if len(depth) == 0:
                return float("nan"), float("nan")
            middle = float(np.median(depth))
            return middle, _DEPTH_SIGMA * middle

        return ranger


def _probability(log_odds: float) -> float:
    return float(1.0 / (1.0 + np.exp(-log_odds)))
