# SPDX-License-Identifier: Apache-2.0
"""Whether an image shows an object of the map, among all that is new about it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edge.changes.cover import find_held, reaches
from edge.changes.expect import Expectation, Sighting, sight
from edge.changes.explain import Shown, claims, explains, may_be_renamed
from edge.changes.glimpse import Glimpse
from edge.changes.newcomers import Newcomers
from edge.config.changes import PresenceConfig


def sighting_of(
    part: Shown,
    seen: Sequence[Glimpse],
    others: Sequence[Shown],
    new: Newcomers,
    config: PresenceConfig,
) -> tuple[Sighting, Expectation]:
    """What the masks of an image say of an object that it must show; `others` are in it, too.

    What was told as new, or is known to be nearer, hides what it covers; the rest must show all
    the same. That is told as well.
    """
    thing, found = part.known.thing, part.found
    over = [g for g in seen if reaches(g.mask, part.low, part.high)]
    nearer = [g.mask for g in over if any(_is_nearer(o, g, part) for o in others)]
    found = replace(found, visible=found.visible & ~find_held(nearer, found.pixels))
    if found.visible.mean() < config.visible_share:
        return "unclear", found
    left_out = {id(g) for g in new.are_apart(over, thing, found.pixels[found.visible])}
    before = [g for g in new.told(over, thing) if not may_be_renamed(part, g)]
    rest = found.visible & ~find_held([g.mask for g in before], found.pixels)
    if rest.mean() >= config.visible_share:
        found = replace(found, visible=rest)
        left_out |= {id(g) for g in before}
    over = [g for g in over if id(g) not in left_out]
    return sight(found, *claims(part, over, others), config), found


def _is_nearer(other: Shown, g: Glimpse, part: Shown) -> bool:
    """Whether a mask is of another object that stands before one."""
    thing, own = other.known.thing, part.known.thing
    if g.label != thing.label or g.label == own.label:  # else it may be of either
        return False
    apart = [float(np.linalg.norm(each.center - g.origin)) for each in (thing, own)]
    return apart[0] < apart[1] and explains(other, g)
