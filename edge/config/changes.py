# SPDX-License-Identifier: Apache-2.0
"""When an object of the map counts as gone."""

from typing import Annotated

from msgspec import Meta, Struct

Share = Annotated[float, Meta(ge=0.0, le=1.0)]


class PresenceConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What it takes to expect an object in an image, and to believe that it is not there."""

    # Points closer to the border are not asked for: masks end there early.
    border_px: Annotated[float, Meta(ge=0.0, le=200.0)] = 8.0
    # Of an object's points; a mask of less is often missed.
    visible_share: Share = 0.6
    # Apparent size; smaller things are found by chance.
    min_size_px: Annotated[float, Meta(ge=1.0, le=1e6)] = 200.0
    # Times the largest distance from which the map's own images saw it.
    range_factor: Annotated[float, Meta(ge=1.0, le=10.0)] = 1.3
    # From the nearest direction the map's own images saw it: another side may look like nothing.
    view_angle_deg: Annotated[float, Meta(gt=0.0, le=180.0)] = 40.0
    # Nearer by more than this share, something stands before it.
    depth_tolerance: Share = 0.08
    # Of visible points under one mask: from here on it is seen, below the lower it is missed.
    seen_share: Share = 0.4
    missed_share: Share = 0.1
    # How often a model sees what is not there, at a given place.
    false_rate: Annotated[float, Meta(gt=0.0, lt=0.5)] = 0.05
    # Bounds what the map says of how often the model finds an object: nothing is certain.
    lowest_hit_rate: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.2
    highest_hit_rate: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.9
    # Images from one place fail together; so much is the most that a viewpoint can say.
    viewpoint_log_odds: Annotated[float, Meta(gt=0.0, le=20.0)] = 2.0
    # Another viewpoint begins so far from all others, as seen from the object.
    viewpoint_deg: Annotated[float, Meta(gt=0.0, le=90.0)] = 8.0
    # Gone below this (1 in 150), over so many viewpoints that say so.
    gone_log_odds: Annotated[float, Meta(lt=0.0, ge=-100.0)] = -5.0
    gone_viewpoints: Annotated[int, Meta(ge=1, le=100)] = 3
