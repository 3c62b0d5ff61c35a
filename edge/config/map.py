# SPDX-License-Identifier: Apache-2.0
"""Which map the daemon looks in."""

from typing import Annotated

from msgspec import Meta, Struct


class MapConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The map of `mapvo run`."""

    # Its folder; empty: there is none, and the odometry alone is published.
    folder: str = ""
    # So much of its tiles stays in memory at most [MB]; the rest is read where the camera comes.
    # A search in the whole map takes ten tiles at once: with less, they are read again and again.
    resident_mb: Annotated[int, Meta(ge=1, le=1_000_000)] = 64

    @property
    def resident_bytes(self) -> int:
        """The same in bytes."""
        return 1_000_000 * self.resident_mb
