# SPDX-License-Identifier: Apache-2.0
"""The changes that have been told."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from edge.types import F64, ChangeEvent, Evidence, Look


class Told:
    """Owned by one thread."""

    def __init__(self, moved_m: float) -> None:
        """A thing that is gone and one of its kind that is new, at most so far apart, is one."""
        self._moved_m = moved_m
        self.events: list[ChangeEvent] = []

    def tell(
        self,
        kind: Literal["removed", "added"],
        label: str,
        space: tuple[F64, F64],
        evidence: Sequence[Evidence],
        says: tuple[float, int],
        look: Look,
    ) -> ChangeEvent:
        """A change of something whose middle and extent (3,) [m] are `space`.

        `says` are the log-odds of its being there and the viewpoints that say so.
        """
        log_odds, n_views = says
        sure = log_odds if kind == "added" else -log_odds
        event = ChangeEvent(
            id=len(self.events),
            t_ns=look.t_ns,
            kind=kind,
            label=label,
            score=float(1.0 / (1.0 + np.exp(-sure))),
            center_map_m=space[0],
            extent_m=space[1],
            n_views=n_views,
            log_odds=log_odds,
            source="model",
            evidence=tuple(evidence),
            partner=self._partner("added" if kind == "removed" else "removed", label, space[0]),
            image=look.image,
        )
        self.events.append(event)
        return event

    def _partner(self, kind: str, label: str, center: F64) -> int | None:
        """The nearest event of the other kind about a thing of this label: it was moved."""
        taken = {event.partner for event in self.events}
        near = [
            (float(np.linalg.norm(event.center_map_m - center)), event.id)
            for event in self.events
            if (event.kind, event.label) == (kind, label) and event.id not in taken
        ]
        distance, number = min(near, default=(np.inf, -1))
        return number if distance <= self._moved_m else None
