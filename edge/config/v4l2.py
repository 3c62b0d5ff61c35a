# SPDX-License-Identifier: Apache-2.0
"""A camera of the kernel's video interface: USB (UVC) and most others."""

from typing import Annotated, Literal

from msgspec import Meta, Struct


class V4l2Config(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which camera, and how it takes its pictures."""

    # A name under /dev/v4l/by-path/ is a socket, and stays the same after a replug; empty:
    # the serial number alone says which camera.
    device: str = ""
    # Of the USB device. With it, no other camera in the same socket is taken for this one.
    serial: str = ""
    # The calibration's size; the camera must give just this.
    width: Annotated[int, Meta(ge=16, le=16384)] = 640
    height: Annotated[int, Meta(ge=16, le=16384)] = 480
    # What direct tracking is tuned for.
    rate_hz: Annotated[float, Meta(ge=1.0, le=1000.0)] = 30.0
    # In the order of preference: grey costs nothing, YUYV and NV12 hold grey, MJPG loses some of
    # it. Where a model looks, those with colour come first.
    formats: Annotated[tuple[Literal["GREY", "YUYV", "NV12", "MJPG"], ...], Meta(min_length=1)] = (
        "GREY",
        "YUYV",
        "NV12",
        "MJPG",
    )
    # Fixed, so that blur stays bounded and the brightness steady; unset: the camera's automatic.
    exposure_us: Annotated[float, Meta(ge=1.0, le=1e6)] | None = None
    # In the camera's own steps; unset: as it is, automatic where the exposure is.
    gain: int | None = None
    # What one of those steps is, by the sensor's data sheet; unset: frames do not tell their gain.
    gain_db_per_step: Annotated[float, Meta(gt=0.0, le=60.0)] | None = None
    # From the first row's read-out to the last one's; a rolling shutter's data sheet says it.
    readout_us: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0
    # `global`: all rows are exposed at once. `rolling`: the stamp is the middle row's.
    shutter: Literal["global", "rolling"] = "rolling"
    # How much later the driver stamps than it says, as measured.
    stamp_delay_us: Annotated[float, Meta(ge=-1e6, le=1e6)] = 0.0
    # Without a frame for so long it counts as gone and is opened anew.
    stall_s: Annotated[float, Meta(ge=0.1, le=60.0)] = 2.0
    # One being filled, one waiting, one being read, one to spare for a late reader.
    buffers: Annotated[int, Meta(ge=2, le=32)] = 4

    def __post_init__(self) -> None:
        if self.exposure_us is not None and self.exposure_us * self.rate_hz > 1e6:
            raise ValueError(
                f"exposure_us {self.exposure_us:g} is longer than a frame at {self.rate_hz:g} Hz: "
                f"set {1e6 / self.rate_hz:.0f} or less"
            )
