# SPDX-License-Identifier: Apache-2.0
"""What has come and gone as the map's surfaces and measured depths alone tell, without any model.

Depths say what may have; images have a veto: they must not show the map's points where these went.
"""

from collections import deque
from typing import Any, NamedTuple

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from edge.changes.cover import mask_of
from edge.changes.depths import View, ask, hull_of, make_view, seen_at, within
from edge.changes.expect import Sighting
from edge.changes.gaps import Gaps
from edge.changes.mapped import Mapped
from edge.changes.presence import Presence
from edge.changes.proof import CONFIRMED, CONTRADICTED, Proof, Prover
from edge.changes.strange import Strange
from edge.config.changes import ChangesConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.reader import Map
from edge.types import F32, F64, I32, Bools, ChangeEvent, Evidence, Look

_KEPT_VIEWS = 80
_LABEL = "unknown"
_MOST_SURE = 0.7  # a model would see more
_HIT_RATE = 0.7  # of views whose depths tell of a thing
_BEHIND = 1.05  # times its depth: what it would hide


class _Outline(NamedTuple):
    """Where an image shows a thing."""

    hull: F32  # (n, 2) ideal pixels
    near_m: float  # depths of its front and back
    far_m: float


class UnlabelledChanges:
    """Changes of a map without the help of a model. Owned by one thread."""

    def __init__(self, map_: Map, camera: CameraModel, config: ChangesConfig) -> None:
        self._map, self._camera, self._config = map_, camera, config
        settings = config.geometry
        proof = msgspec.structs.replace(
            config.proof, max_points=settings.max_points, angle_deg=settings.angle_deg
        )
        self._prover = Prover(map_, camera, proof)
        self._mapped = Mapped(map_, settings)
        self._gaps = Gaps(self._mapped, camera.pinhole, config)
        self._strange = Strange(self._mapped, config)
        self._views: deque[View] = deque(maxlen=_KEPT_VIEWS)
        self.events: list[ChangeEvent] = []

    def step(self, look: Look) -> list[ChangeEvent]:
        """What has become sure with this image."""
        view = make_view(look, self._camera.pinhole, self._config.geometry.depth_share)
        if self._mapped.move_to(view.origin):
            self._gaps.carry_over()
        self._gaps.add(view)
        self._strange.add(view)
        groups = [("removed", xyz) for xyz in self._gaps.groups()]
        groups += [("added", xyz) for xyz in self._strange.groups()]
        seen = [
            (kind, xyz, outline)
            for kind, xyz in groups
            if self._is_news(kind, xyz) and (outline := self._outline(view, xyz)) is not None
        ]
        if seen:
            view = view._replace(proof=self._prove(look, [outline for *_, outline in seen]))
        self._views.append(view)
        told = (self._judge(kind, xyz, look) for kind, xyz, _ in seen)
        return [event for event in told if event is not None]

    def _is_news(self, kind: str, xyz: F64) -> bool:
        """Whether nothing of this kind was told about that place."""
        low, high = xyz.min(axis=0), xyz.max(axis=0)
        return not any(
            event.kind == kind
            and (
                np.abs(event.center_map_m - 0.5 * (low + high))
                < 0.5 * (high - low + event.extent_m) + self._config.geometry.cell_m
            ).all()
            for event in self.events
        )

    def _outline(self, view: View, xyz: F64) -> _Outline | None:
        """Where an image shows most of a thing's cells (n, 3); None where it does not."""
        camera = self._camera.pinhole
        pixels, depth = seen_at(view.T_map_cam, xyz, camera)
        inside = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(axis=1)
        inside &= depth < self._config.geometry.range_m
        if inside.mean() < self._config.presence.visible_share:
            return None
        own = depth[inside]
        return _Outline(hull_of(pixels[inside]), float(own.min()), float(own.max()))

    def _prove(self, look: Look, outlines: list[_Outline]) -> Proof:
        """What the image says of the map's points about things."""

        def matters(_points: I32, pixels: F32) -> Bools:
            at = self._camera.undistort(self._camera.normalise(pixels.astype(np.float64)))
            pinhole = self._camera.pinhole
            ideal = at * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
            held = [within(outline.hull, ideal) for outline in outlines]
            chosen: Bools = np.any(held, axis=0)
            return chosen

        proof = self._prover.prove(look.image, look.T_map_cam, matters, alone=True)
        found, settings = self._map.points(proof.points), self._config.geometry
        sure = found.n_views >= settings.point_views
        sure &= found.parallax_rad >= np.radians(settings.point_parallax_deg)
        columns: list[Any] = [column[sure] for column in proof]
        return Proof(*columns)

    def _judge(self, kind: str, xyz: F64, look: Look) -> ChangeEvent | None:
        """The event of a thing that depths tell of, if all views agree enough."""
        config = self._config
        prior = config.presence.new_log_odds if kind == "added" else None
        presence, center = Presence(config.presence, prior), xyz.mean(axis=0)
        evidence, asked, same, other = [], 0, 0, 0
        for view in self._views:
            outline = self._outline(view, xyz)
            if outline is None:
                continue
            sighting = _sighting(view, outline, kind)
            distance = float(np.linalg.norm(view.origin - center))
            presence.add(sighting, view.origin, distance, _HIT_RATE)
            if sighting == ("seen" if kind == "added" else "missed"):
                evidence.append(self._evidence(view, xyz))
            if view.proof is not None:
                asked += 1
                verdict = self._verdict(view.proof, view, outline, xyz, kind)
                same += int((verdict == CONFIRMED).sum())
                other += int((verdict == CONTRADICTED).sum())
        is_sure = presence.is_there if kind == "added" else presence.is_gone
        if not is_sure or asked < config.geometry.views or same > other:
            return None
        return self._tell(kind, xyz, presence, tuple(evidence), look)

    def _verdict(self, proof: Proof, view: View, outline: _Outline, xyz: F64, kind: str) -> I32:
        """What an image says of the points that are on what has gone, or behind what has come."""
        if len(proof.points) == 0:
            return proof.verdict
        if kind == "removed":
            own = cKDTree(xyz).query(proof.xyz)[0] < self._config.geometry.cell_m
            on_it: I32 = proof.verdict[own]
            return on_it
        pixels, _ = seen_at(view.T_map_cam, proof.xyz, self._camera.pinhole)
        hidden = within(outline.hull, pixels) & (proof.depth_m > _BEHIND * outline.far_m)
        said: I32 = proof.verdict[hidden]
        return said

    def _tell(
        self,
        kind: str,
        xyz: F64,
        presence: Presence,
        evidence: tuple[Evidence, ...],
        look: Look,
    ) -> ChangeEvent:
        low, high = xyz.min(axis=0), xyz.max(axis=0)
        is_new = kind == "added"
        odds = presence.log_odds if is_new else -presence.log_odds
        event = ChangeEvent(
            id=len(self.events),
            t_ns=look.t_ns,
            kind=kind,
            label=_LABEL,
            score=float(_MOST_SURE / (1.0 + np.exp(-odds))),
            center_map_m=0.5 * (low + high),
            extent_m=high - low,
            n_views=presence.n_for if is_new else presence.n_against,
            log_odds=presence.log_odds,
            source="geometry",
            evidence=evidence,
            image=look.image,
        )
        self.events.append(event)
        return event

    def _evidence(self, view: View, xyz: F64) -> Evidence:
        local = se3.transform(se3.inverse(view.T_map_cam), xyz)
        pixels = self._camera.project(local).astype(np.float32)
        mask = mask_of(pixels[np.isfinite(pixels[:, 0])], self._camera)
        return Evidence(view.frame_index, view.t_ns, view.T_map_cam, mask)


def _sighting(view: View, outline: _Outline, kind: str) -> Sighting:
    """Whether a view's depths tell that a thing is there; a thing that came is asked for itself."""
    told = ask(view, outline.hull, outline.near_m, outline.far_m)
    if told.there >= max(told.behind, 1):
        return "seen"
    if told.before > 0 or told.behind == 0:
        return "unclear"
    return "missed" if kind == "removed" or told.behind > 2 * told.there else "unclear"
