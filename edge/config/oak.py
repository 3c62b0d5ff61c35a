# SPDX-License-Identifier: Apache-2.0
"""A Luxonis OAK camera (extra `oak`)."""

from typing import Annotated, Literal

from msgspec import Meta, Struct


class OakConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which device and sensor, and how it takes its pictures."""

    # The device's id, as printed on it; empty: the only one that is plugged in.
    device_id: str = ""
    # CAM_A is the colour sensor, CAM_B and CAM_C are the grey global-shutter ones of most devices.
    socket: Literal["CAM_A", "CAM_B", "CAM_C", "CAM_D"] = "CAM_B"
    width: Annotated[int, Meta(ge=16, le=16384)] = 640
    height: Annotated[int, Meta(ge=16, le=16384)] = 400
    # What direct tracking is tuned for.
    rate_hz: Annotated[float, Meta(ge=1.0, le=240.0)] = 30.0
    # Fixed, so that blur stays bounded and the brightness steady; unset: automatic, up to the
    # limit.
    exposure_us: Annotated[int, Meta(ge=1, le=1_000_000)] | None = None
    # Of the sensor, with a fixed exposure.
    iso: Annotated[int, Meta(ge=100, le=3200)] = 400
    # Automatic exposure stays below it, for the sake of blur.
    exposure_limit_us: Annotated[int, Meta(ge=1, le=1_000_000)] = 10_000
    # A device without its own factory calibration answers with its model's: some 1 % off.
    allow_default_calibration: bool = False
    # Without a frame for so long it counts as gone and is opened anew.
    stall_s: Annotated[float, Meta(ge=0.5, le=60.0)] = 3.0
    # Booting its firmware takes some seconds.
    open_timeout_s: Annotated[float, Meta(ge=1.0, le=120.0)] = 20.0

    def __post_init__(self) -> None:
        exposure_us = self.exposure_us or self.exposure_limit_us
        if exposure_us * self.rate_hz > 1e6:
            key = "exposure_us" if self.exposure_us else "exposure_limit_us"
            raise ValueError(
                f"{key} {exposure_us} is longer than a frame at {self.rate_hz:g} Hz: "
                f"set {1e6 / self.rate_hz:.0f} or less"
            )
