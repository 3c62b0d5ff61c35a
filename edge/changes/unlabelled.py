# SPDX-License-Identifier: Apache-2.0
"""What has come and gone as the map's points and measured depths alone tell, without any model."""

from collections import OrderedDict
from typing import Any

import msgspec
import numpy as np

from edge.changes.appeared import New, Unexplained
from edge.changes.cover import mask_of
from edge.changes.depths import View, make_view
from edge.changes.free_space import MapRays
from edge.changes.memory import PointMemory
from edge.changes.presence import Presence
from edge.changes.proof import Proof, Prover
from edge.changes.vanished import Gone, find_gone
from edge.config.changes import ChangesConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.reader import Map
from edge.types import F32, F64, I32, Bools, ChangeEvent, Evidence, Look

_KEPT_VIEWS = 80
_LABEL = "unknown"
_MOST_SURE = 0.7  # a model would see more


class UnlabelledChanges:
    """Changes of a map without the help of a model. Owned by one thread."""

    def __init__(self, map_: Map, camera: CameraModel, config: ChangesConfig) -> None:
        self._map, self._camera, self._config = map_, camera, config
        geometry = config.geometry
        proof = msgspec.structs.replace(
            config.proof, max_points=geometry.max_points, angle_deg=geometry.angle_deg
        )
        self._prover = Prover(map_, camera, proof)
        self._memory = PointMemory(config.presence.viewpoint_share)
        self._views: OrderedDict[int, View] = OrderedDict()
        self._number = 0
        self._unexplained = Unexplained(camera.pinhole, MapRays(map_), config)
        self.events: list[ChangeEvent] = []

    def step(self, look: Look) -> list[ChangeEvent]:
        """What has become sure with this image."""
        proof = self._sure(self._prover.prove(look.image, look.T_map_cam, self._preference))
        self._number += 1
        pinhole = self._camera.pinhole
        view = make_view(self._number, look, proof, pinhole)
        self._views[view.number] = view
        while len(self._views) > _KEPT_VIEWS:
            self._views.popitem(last=False)
        self._memory.add(view.number, view.origin, proof)
        self._unexplained.add(view)
        gone = find_gone(self._memory, self._views, pinhole, proof.points, self._config)
        told = [self._tell_gone(g, look) for g in gone if self._is_news("removed", g.xyz)]
        for new in self._unexplained.find(self._views, view.number):
            self._unexplained.forget(new)
            if self._is_news("added", new.xyz):
                told.append(self._tell_new(new, look))
        return told

    def _is_news(self, kind: str, xyz: F64) -> bool:
        """Whether nothing of this kind was told about that place."""
        center, size = xyz.mean(axis=0), float(np.linalg.norm(np.ptp(xyz, axis=0)))
        for event in self.events:
            reach = size + float(np.linalg.norm(event.extent_m))
            if event.kind == kind and np.linalg.norm(event.center_map_m - center) < reach:
                return False
        return True

    def _preference(self, points: I32, _: F32) -> Bools:
        return self._memory.are_doubted(points)

    def _sure(self, proof: Proof) -> Proof:
        """Only points that the map is sure of."""
        found, config = self._map.points(proof.points), self._config.geometry
        sure = found.n_views >= config.point_views
        sure &= found.parallax_rad >= np.radians(config.point_parallax_deg)
        columns: list[Any] = [column[sure] for column in proof]
        return Proof(*columns)

    def _tell_gone(self, gone: Gone, look: Look) -> ChangeEvent:
        score = _MOST_SURE / (1.0 + np.exp(gone.presence.log_odds))
        return self._tell("removed", gone.xyz, gone.views, gone.presence, float(score), look)

    def _tell_new(self, new: New, look: Look) -> ChangeEvent:
        score = _MOST_SURE / (1.0 + np.exp(-new.presence.log_odds))
        return self._tell("added", new.xyz, new.views, new.presence, float(score), look)

    def _tell(
        self,
        kind: str,
        xyz: F64,
        numbers: tuple[int, ...],
        presence: Presence,
        score: float,
        look: Look,
    ) -> ChangeEvent:
        low, high = np.percentile(xyz, (5.0, 95.0), axis=0)
        shown = dict.fromkeys((*numbers, self._number))  # the last is of the event's own image
        event = ChangeEvent(
            id=len(self.events),
            t_ns=look.t_ns,
            kind=kind,
            label=_LABEL,
            score=score,
            center_map_m=0.5 * (low + high),
            extent_m=high - low,
            n_views=presence.n_against if kind == "removed" else presence.n_for,
            log_odds=presence.log_odds,
            source="geometry",
            evidence=tuple(self._evidence(self._views[number], xyz) for number in shown),
            image=look.image,
        )
        self.events.append(event)
        return event

    def _evidence(self, view: View, xyz: F64) -> Evidence:
        local = se3.transform(se3.inverse(view.T_map_cam), xyz)
        mask = mask_of(self._camera.project(local).astype(np.float32), self._camera)
        return Evidence(view.frame_index, view.t_ns, view.T_map_cam, mask)
