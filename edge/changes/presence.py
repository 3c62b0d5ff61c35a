# SPDX-License-Identifier: Apache-2.0
"""What views of one place add up to: whether the object is still there.

Log-odds of being there. A view that finds it adds the log of how much likelier that is with it
there than without, and so does one that misses it; how often the model finds this very object from
there was counted when the map was made. Images from one viewpoint fail together, so what a
viewpoint can say is bounded, and only several of them can tell that something is gone.
"""

import math

import numpy as np

from edge.changes.expect import Sighting
from edge.config.changes import PresenceConfig
from edge.types import F64

_ALIKE_LOOKS = 2.0  # images from one viewpoint say no more than so many


class Presence:
    """The evidence about one object. Owned by one thread."""

    def __init__(self, config: PresenceConfig, prior: float | None = None) -> None:
        """Begin with the log-odds `prior`; that it is in the map is as good as a sure viewpoint."""
        self._config = config
        self._prior = config.viewpoint_log_odds if prior is None else prior
        self._places: F64 = np.empty((0, 3))  # of the cameras, one of each viewpoint
        self._said: list[float] = []  # of each viewpoint
        self._clear: list[int] = []  # of each, how many more images were clear than were not

    @property
    def log_odds(self) -> float:
        """Of its being there."""
        return self._prior + sum(self._said)

    @property
    def n_against(self) -> int:
        """Viewpoints from which it is rather not there."""
        return sum(said < 0.0 for said in self._said)

    @property
    def n_for(self) -> int:
        """Viewpoints from which it is rather there."""
        return sum(said > 0.0 for said in self._said)

    @property
    def n_unclear(self) -> int:
        """Viewpoints from which no more images could tell than could not."""
        return sum(clear <= 0 for clear in self._clear)

    @property
    def is_there(self) -> bool:
        """Whether it is surely there."""
        config = self._config
        return self.log_odds >= config.there_log_odds and self.n_for >= config.there_viewpoints

    @property
    def is_gone(self) -> bool:
        """Whether it is surely not there any more."""
        return self.is_gone_times(1)

    @property
    def is_gone_twice(self) -> bool:
        """Whether it is as surely gone as `is_gone` asks for, twice over."""
        return self.is_gone_times(2)

    def is_gone_times(self, n: int) -> bool:
        """Whether it is as surely gone as `is_gone` asks for, `n` times over."""
        config = self._config
        return (
            self.log_odds <= n * config.gone_log_odds
            and self.n_against >= n * config.gone_viewpoints
        )

    @property
    def is_nearly_gone(self) -> bool:
        """Whether half of what a viewpoint can say is all that lacks."""
        config = self._config
        nearly = self.log_odds <= config.gone_log_odds + 0.5 * config.viewpoint_log_odds
        return nearly and self.n_against >= config.gone_viewpoints

    def add(
        self,
        sighting: Sighting,
        origin: F64,
        distance_m: float,
        hit_rate: float,
        weight: float = 1.0,
    ) -> None:
        """Take a view in which it was expected, of a camera at `origin` (3,), so far from it.

        `hit_rate` is the share of views from there in which the model finds it when it is there;
        `weight` how much of what that tells is believed.
        """
        i = self.viewpoint(origin, distance_m)
        self._clear[i] += -1 if sighting == "unclear" else 1
        step = weight * self._step(sighting, hit_rate)
        # A model that misses it now and then misses it in all images from a place.
        bound = min(self._config.viewpoint_log_odds, _ALIKE_LOOKS * abs(step))
        if step > 0.0:
            self._said[i] = max(self._said[i], min(self._said[i] + step, bound))
        elif step < 0.0:
            self._said[i] = min(self._said[i], max(self._said[i] + step, -bound))

    def _step(self, sighting: Sighting, hit_rate: float) -> float:
        config = self._config
        if sighting == "missed" and hit_rate < config.lowest_hit_rate:
            return 0.0
        rate = min(max(hit_rate, config.lowest_hit_rate), config.highest_hit_rate)
        if sighting == "seen":
            return math.log(rate / config.false_rate)
        if sighting == "missed":
            return math.log((1.0 - rate) / (1.0 - config.false_rate))
        return 0.0

    def viewpoint(self, origin: F64, distance_m: float) -> int:
        """Number of the viewpoint of a camera's place; a new one where it is far from all."""
        if len(self._places):
            apart = np.linalg.norm(self._places - origin, axis=1)
            nearest = int(apart.argmin())
            if apart[nearest] < self._config.viewpoint_share * distance_m:
                return nearest
        self._places = np.vstack((self._places, origin))
        self._said.append(0.0)
        self._clear.append(0)
        return len(self._said) - 1
