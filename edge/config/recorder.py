# SPDX-License-Identifier: Apache-2.0
"""What the daemon keeps of the recent past."""

from typing import Annotated, Literal

from msgspec import Meta, Struct


class RecorderConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A ring of recording files (MCAP), the newest always there; edge/capture/FORMAT.md explains.

    Some 4 MB/s at 640x480 and 30 Hz: a folder in memory (/run) spares an SD card.
    """

    # Where the files go; empty: nothing is kept.
    folder: str = ""
    # A file ends after so long: what is removed or lost at once.
    segment_s: Annotated[float, Meta(ge=1.0, le=3600.0)] = 20.0
    # The oldest files go when all together are larger.
    keep_mb: Annotated[float, Meta(ge=10.0, le=10_000_000.0)] = 500.0
    # Nothing is written while the disk has less than this left: others need it, too.
    min_free_mb: Annotated[float, Meta(ge=0.0, le=1_000_000.0)] = 200.0
    # `png`: smallest, some 6 ms CPU a frame at 640x480. `raw`: half of that, half as large again.
    images: Literal["png", "raw"] = "png"
    # Every so many frames one image is kept; poses and states of all are.
    image_stride: Annotated[int, Meta(ge=1, le=1000)] = 1
