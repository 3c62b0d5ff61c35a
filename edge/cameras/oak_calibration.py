# SPDX-License-Identifier: Apache-2.0
"""A camera model of what an OAK device says about its lens."""

import logging
from collections.abc import Sequence

import cv2
import numpy as np

from edge.errors import CameraRefused, ConfigError
from edge.geometry import distortion, so3
from edge.geometry.camera import CameraModel
from edge.types import F64

log = logging.getLogger(__name__)

# depthai's order of Perspective: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty.
_RADIAL_TANGENTIAL = 8
# A lens with thin-prism and tilt terms is carried by the nearest one without, where that is so
# near that no corner could tell.
_NEAR_PX = 0.2
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
    terms = tuple(map(float, coefficients))
    fx, fy, cx, cy = K[0][0], K[1][1], K[0][2], K[1][2]
    try:
        if model == "Perspective" and len(terms) in (12, 14) and any(terms[_RADIAL_TANGENTIAL:]):
            kept = terms[:_RADIAL_TANGENTIAL]
            start = CameraModel(width, height, fx, fy, cx, cy, distortion.RADTAN, kept)
            return _nearest(start, np.array(K), np.array(terms))
        kind, kept = _lens(model, terms)
        return CameraModel(width, height, fx, fy, cx, cy, kind, kept)
    except ConfigError as error:
        raise CameraRefused(f"the device's calibration: {error}: {_REMEDY}") from error


def _lens(model: str, coefficients: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    """Our name of the lens model and its coefficients, without zeros that say nothing."""
    if model == "Perspective":
        if not any(coefficients):
            return distortion.NONE, ()
        if len(coefficients) not in _SIZES:
            count = len(coefficients)
            raise CameraRefused(f"the device's calibration: has {count} lens terms: {_REMEDY}")
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


def _nearest(start: CameraModel, K: F64, terms: F64) -> CameraModel:
    """The camera without thin-prism and tilt terms that sees as one with them does.

    K (3, 3) and terms (12,) or (14,) are those of the full model, in OpenCV's order. A tilted
    sensor is much like a turned camera, so that the nearest one looks a hair's breadth elsewhere.
    """
    from scipy.optimize import least_squares  # heavy, and seldom needed

    rays = _rays_of(start)
    raw = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, terms)[0].reshape(-1, 2)

    def off_px(values: F64) -> F64:
        turn, (fx, fy, cx, cy), lens = values[:3], values[3:7], values[7:]
        turned = rays @ so3.exp(turn).T
        plane = turned[:, :2] / turned[:, 2:]
        seen = distortion.distort(distortion.RADTAN, tuple(lens), plane)
        difference: F64 = (seen * (fx, fy) + (cx, cy) - raw).ravel()
        return difference

    values = [0.0, 0.0, 0.0, start.fx, start.fy, start.cx, start.cy, *start.distortion]
    found = least_squares(off_px, values, x_scale="jac", max_nfev=50)
    worst_px = float(np.abs(found.fun).max())
    turned_deg = float(np.degrees(np.linalg.norm(found.x[:3])))
    if not worst_px < _NEAR_PX:
        raise CameraRefused(
            "the device's calibration: its thin-prism and tilt terms are not carried, and the "
            f"nearest lens without them is {worst_px:.2f} px off: {_REMEDY}"
        )
    log.info("event=lens_approximated worst_px=%.3f turned_deg=%.3f", worst_px, turned_deg)
    fx, fy, cx, cy, *lens = map(float, found.x[3:])
    return CameraModel(start.width, start.height, fx, fy, cx, cy, distortion.RADTAN, tuple(lens))


def _rays_of(camera: CameraModel) -> F64:
    """Rays (n, 3) all over the image, z = 1."""
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 16), np.linspace(0, camera.height - 1, 12))
    plane = camera.normalise(camera.undistort_pixels(np.stack((u.ravel(), v.ravel()), axis=1)))
    plane = plane[np.isfinite(plane).all(axis=1)]
    return np.column_stack((plane, np.ones(len(plane))))
