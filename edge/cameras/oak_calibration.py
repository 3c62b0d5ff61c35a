# SPDX-License-Identifier: Apache-2.0
"""A camera model of what an OAK device says about its lens."""

from collections.abc import Sequence

from edge.errors import CameraRefused, ConfigError
from edge.geometry import distortion
from edge.geometry.camera import CameraModel

# depthai's order of Perspective: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty.
_RADIAL_TANGENTIAL = 8
_SIZES = (*distortion.COEFFICIENT_COUNTS[distortion.RADTAN], 12, 14)
_REMEDY = "calibrate it yourself (`mapvo calibrate`) and name that in camera.calibration"


def camera_from_device(
    model: str,
    K: Sequence[Sequence[float]],
    coefficients: Sequence[float],
    width: int,
    height: int,
) -> CameraModel:
    """Camera of an image of width x height, whose intrinsics K (3, 3) [px] are.

    `model` is depthai's name of the lens model. CameraRefused where that is one which cannot be
    carried, or what the device says makes no sense.
    """
    kind, kept = _lens(model, tuple(map(float, coefficients)))
    fx, fy, cx, cy = K[0][0], K[1][1], K[0][2], K[1][2]
    try:
        return CameraModel(width, height, fx, fy, cx, cy, kind, kept)
    except ConfigError as error:
        raise CameraRefused(f"the device's calibration: {error}: {_REMEDY}") from error


def _lens(model: str, coefficients: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    """Our name of the lens model and its coefficients, without zeros that say nothing."""
    if model == "Perspective":
        if not any(coefficients):
            return distortion.NONE, ()
        beyond = coefficients[_RADIAL_TANGENTIAL:]
        if len(coefficients) not in _SIZES or any(beyond):
            raise CameraRefused(
                "the device's calibration: its lens model has thin-prism or tilt terms, which are "
                f"not carried: {_REMEDY}"
            )
        kept = coefficients[:_RADIAL_TANGENTIAL]
        for shorter in (5, 4):
            if not any(kept[shorter:]):
                kept = kept[:shorter]
        return distortion.RADTAN, kept
    if model == "Fisheye":
        if len(coefficients) < 4 or any(coefficients[4:]):
            raise CameraRefused(f"the device's calibration: is no whole fisheye one: {_REMEDY}")
        return distortion.EQUIDISTANT, coefficients[:4]
    raise CameraRefused(f"the device's calibration: lens model {model} is not carried: {_REMEDY}")
