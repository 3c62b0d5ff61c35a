# SPDX-License-Identifier: Apache-2.0
"""What views of one place add up to: whether the object is still there.

Log-odds of being there. A view that finds it adds the log of how much likelier that is with it
there than without, and so does one that misses it; how often the model finds this very object was
counted when the map was made. Images from one viewpoint fail together, so what a viewpoint can say
is bounded, and only several of them can tell that something is gone.
"""

import math

import numpy as np

from edge.changes.expect import Sighting
from edge.config.changes import PresenceConfig
from edge.types import F64


class Presence:
    """The evidence about one object. Owned by one thread."""

    def __init__(self, hit_rate: float, config: PresenceConfig) -> None:
        self._config = config
        rate = min(max(hit_rate, config.lowest_hit_rate), config.highest_hit_rate)
        self._step = {
            "seen": math.log(rate / config.false_rate),
            "missed": math.log((1.0 - rate) / (1.0 - config.false_rate)),
            "unclear": 0.0,
        }
        # That it is in the map is as good as one sure viewpoint.
        self._prior = config.viewpoint_log_odds
        self._directions: list[F64] = []
        self._said: list[float] = []  # of each viewpoint

    @property
    def log_odds(self) -> float:
        """Of its being there."""
        return self._prior + sum(self._said)

    @property
    def n_against(self) -> int:
        """Viewpoints from which it is rather not there."""
        return sum(said < 0.0 for said in self._said)

    @property
    def is_gone(self) -> bool:
        """Whether it is surely not there any more."""
        config = self._config
        sure = self.log_odds <= config.gone_log_odds
        return sure and self.n_against >= config.gone_viewpoints

    def add(self, sighting: Sighting, direction: F64) -> None:
        """Take a view in which it was expected; `direction` (3,) points from it to the camera."""
        i = self._viewpoint(direction)
        bound = self._config.viewpoint_log_odds
        self._said[i] = min(max(self._said[i] + self._step[sighting], -bound), bound)

    def _viewpoint(self, direction: F64) -> int:
        """The viewpoint that a direction belongs to; a new one where it is far from all."""
        if self._directions:
            cosines = np.stack(self._directions) @ direction
            nearest = int(cosines.argmax())
            if cosines[nearest] > math.cos(math.radians(self._config.viewpoint_deg)):
                return nearest
        self._directions.append(direction)
        self._said.append(0.0)
        return len(self._said) - 1
