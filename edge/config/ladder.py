# SPDX-License-Identifier: Apache-2.0
"""What the daemon gives up, step by step, when it is too hot, too weakly fed or too slow."""

from typing import Annotated

from msgspec import Meta, Struct

_Seconds = Annotated[float, Meta(ge=0.0, le=3600.0)]
_Celsius = Annotated[float, Meta(ge=0.0, le=150.0)]
_Share = Annotated[float, Meta(gt=0.0, le=10.0)]


class LadderConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Changes off, then relocalise less, then the lean preset, then every second frame."""

    # Whether to step down at all.
    enabled: bool = True
    # Most boards throttle their cores at 80 to 85: be slower by our own choice before that.
    hot_c: _Celsius = 78.0
    # Cool again; the distance keeps it from going up and down with each gust.
    cool_c: _Celsius = 70.0
    # Share of a frame's interval that its tracking takes (median): above, frames get lost soon.
    busy_share: _Share = 0.85
    # Below, there is room for the next step up.
    idle_share: _Share = 0.5
    # Share of frames that were overtaken by newer ones.
    dropped_share: _Share = 0.05
    # Trouble must last so long before the next step down ...
    down_after_s: _Seconds = 3.0
    # ... and its absence so long before the next step up.
    up_after_s: _Seconds = 30.0
    # Relocalising less: so many times fewer queries while tracking.
    query_stretch: Annotated[int, Meta(ge=1, le=100)] = 3

    def __post_init__(self) -> None:
        if self.cool_c >= self.hot_c:
            raise ValueError(f"cool_c {self.cool_c:g} must be below hot_c {self.hot_c:g}")
        if self.idle_share >= self.busy_share:
            raise ValueError(
                f"idle_share {self.idle_share:g} must be below busy_share {self.busy_share:g}"
            )
