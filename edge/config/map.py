# SPDX-License-Identifier: Apache-2.0
"""Which map the daemon looks in."""

from msgspec import Struct


class MapConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The map of `mapvo run`."""

    # Its folder; empty: there is none, and the odometry alone is published.
    folder: str = ""
