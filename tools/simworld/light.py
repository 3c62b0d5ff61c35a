# SPDX-License-Identifier: Apache-2.0
"""Another light in the same room."""

from dataclasses import replace

import numpy as np

from tools.simworld.noise import Bgr
from tools.simworld.world import World


def relit(world: World, seed: int, stops: float = 0.7, hue: float = 0.08) -> World:
    """The world at another hour: each lamp, and what comes from everywhere, brighter or darker.

    `stops` is the most by which light changes, as a power of two, and `hue` by how much more its
    channels may differ; shadows change with the lamps.
    """
    rng = np.random.default_rng([seed, 808])

    def other(light: Bgr) -> Bgr:
        gain = 2.0 ** rng.uniform(-stops, stops) * (1.0 + rng.uniform(-hue, hue, 3))
        b, g, r = (float(value) for value in np.array(light) * gain)
        return b, g, r

    lamps = tuple(replace(lamp, power=other(lamp.power)) for lamp in world.lamps)
    return replace(world, lamps=lamps, ambient=other(world.ambient))
