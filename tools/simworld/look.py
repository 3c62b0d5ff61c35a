# SPDX-License-Identifier: Apache-2.0
"""Which materials a room wears; apart from the arrangement, so that two rooms can look alike."""

import numpy as np

from tools.simworld.furniture import picture, surface
from tools.simworld.noise import Bgr
from tools.simworld.world import Material, Texture

WALLS: tuple[tuple[str, Bgr], ...] = (
    ("plaster", (190.0, 205.0, 212.0)),
    ("brick", (82.0, 102.0, 165.0)),
    ("plaster", (185.0, 190.0, 170.0)),
    ("plaster", (160.0, 195.0, 205.0)),
    ("terrazzo", (178.0, 184.0, 186.0)),
    ("speckle", (120.0, 160.0, 190.0)),
)
FLOORS: tuple[tuple[str, Bgr], ...] = (
    ("carpet", (120.0, 106.0, 98.0)),
    ("planks", (92.0, 132.0, 176.0)),
    ("tiles", (172.0, 182.0, 186.0)),
    ("terrazzo", (165.0, 172.0, 176.0)),
    ("carpet", (84.0, 98.0, 110.0)),
    ("checker", (180.0, 190.0, 188.0)),
)
WOODS: tuple[Bgr, ...] = ((96.0, 142.0, 188.0), (66.0, 98.0, 136.0), (150.0, 182.0, 204.0))
CLOTHS: tuple[Bgr, ...] = ((92.0, 84.0, 70.0), (70.0, 80.0, 128.0), (96.0, 112.0, 78.0))
PICTURES = ("poster", "photograph", "poster", "document", "poster", "photograph")


class Look:
    """Hands out materials, the same sequence for the same seed.

    Where `paint` names a material, the builder covers all of them with it.
    """

    def __init__(self, seed: int, *, paint: str | None = None) -> None:
        self._rng = np.random.default_rng([seed, 4711])
        self.paint = paint

    @property
    def bare(self) -> bool:
        """Whether all is painted over."""
        return self.paint is not None

    def seed(self) -> int:
        """A number for a texture of its own."""
        return int(self._rng.integers(1 << 30))

    def pale(self) -> Bgr:
        """A light colour with a slight hue."""
        b, g, r = self._rng.uniform(175, 235) + self._rng.uniform(-18, 8, 3)
        return float(b), float(g), float(r)

    def _repeating(
        self, kind: str, colour: Bgr, size_m: tuple[float, float], size_px: tuple[int, int]
    ) -> Material:
        return surface(kind, colour, self.seed(), size_m, size_px)

    def walls(self) -> list[Material]:
        """Four walls; the first two differ in kind."""
        order = self._rng.permutation(len(WALLS))[:4]
        made = []
        for i in order:
            kind, colour = WALLS[i]
            if self.bare:
                colour = self.pale()
            made.append(self._repeating(kind, colour, (5.4, 2.7), (1024, 2048)))
        return made

    def floor(self) -> Material:
        """The floor."""
        kind, colour = FLOORS[self._rng.integers(len(FLOORS))]
        return self._repeating(kind, colour, (5.2, 5.2), (2048, 2048))

    def ceiling(self) -> Material:
        """The ceiling: panels, or nothing at all."""
        return self._repeating("tiles", (212.0, 216.0, 216.0), (9.6, 9.6), (1024, 1024))

    def wood(self) -> Material:
        """A wooden surface."""
        colour = WOODS[self._rng.integers(len(WOODS))]
        return self._repeating("wood", colour, (1.3, 1.3), (512, 512))

    def cloth(self) -> Material:
        """Upholstery."""
        colour = CLOTHS[self._rng.integers(len(CLOTHS))]
        return self._repeating("fabric", colour, (0.5, 0.5), (256, 256))

    def image(self, kind: str, size_px: tuple[int, int] = (512, 512)) -> Material:
        """A picture of a given kind."""
        return picture(kind, self.pale(), self.seed(), size_px)

    def poster(self) -> Material:
        """Some picture for a wall."""
        return self.image(PICTURES[self._rng.integers(len(PICTURES))])

    def window(self) -> Material:
        """A bright window."""
        sky = Texture("view", (250.0, 244.0, 236.0), self.seed(), (512, 512))
        return Material(sky, None, False, 1.12)
