# SPDX-License-Identifier: Apache-2.0
"""Whether an image shows an object of the map, among all that is new about it."""

from collections.abc import Sequence
from dataclasses import replace

from edge.changes.cover import find_held, reaches
from edge.changes.expect import Sighting, sight
from edge.changes.explain import Shown, claims, may_be_renamed
from edge.changes.glimpse import Glimpse
from edge.changes.newcomers import Newcomers
from edge.config.changes import PresenceConfig


def sighting_of(
    part: Shown,
    seen: Sequence[Glimpse],
    others: Sequence[Shown],
    new: Newcomers,
    config: PresenceConfig,
) -> Sighting:
    """What the masks of an image say of an object that it must show; `others` are in it, too.

    What was told as new hides what it covers; the rest must show all the same.
    """
    thing, found = part.known.thing, part.found
    over = [g for g in seen if reaches(g.mask, part.low, part.high)]
    left_out = {id(g) for g in new.are_apart(over, thing)}
    before = [g for g in new.told(over, thing) if not may_be_renamed(part, g)]
    rest = found.visible & ~find_held([g.mask for g in before], found.pixels)
    if rest.mean() >= config.visible_share:
        found = replace(found, visible=rest)
        left_out |= {id(g) for g in before}
    over = [g for g in over if id(g) not in left_out]
    return sight(found, *claims(part, over, others), config)
