# SPDX-License-Identifier: Apache-2.0
"""How frames are handed to the stages."""

from typing import Annotated

from msgspec import Meta, Struct, field

from edge.config.ladder import LadderConfig
from edge.config.threads import ThreadsConfig


class RuntimeConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Rates and delays of the work beside the tracking thread."""

    # A fix takes effect so many frames after its query in replay: live it takes up to 100 ms.
    relocalise_delay_frames: Annotated[int, Meta(ge=1, le=300)] = 3
    # At most so long, though, where frames come seldom.
    relocalise_delay_s: Annotated[float, Meta(gt=0.0)] = 0.1
    # While tracking, keyframes are tried on the map; without one for so long, the frame itself.
    tracking_query_interval_frames: Annotated[int, Meta(ge=1, le=10_000)] = 15
    # Keyframes that come faster than this are left out once the place is certain: the next will do.
    tracking_query_least_s: Annotated[float, Meta(ge=0.0, le=60.0)] = 0.25
    # While the odometry does not track, every so many frames one is tried on the map.
    lost_query_interval_frames: Annotated[int, Meta(ge=1, le=300)] = 2
    # ... and after so long in any case, where frames come seldom.
    lost_query_interval_s: Annotated[float, Meta(gt=0.0, le=60.0)] = 0.1
    ladder: LadderConfig = field(default_factory=LadderConfig)
    threads: ThreadsConfig = field(default_factory=ThreadsConfig)
