# SPDX-License-Identifier: Apache-2.0
"""What a lens does to the errors of features: they are made in the raw image, not in the ideal one.

A wide lens packs much of the scene into few pixels near its border. In the ideal image these are
stretched, and so is the noise of what is found there. And rows may be read one after another.
"""

import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.geometry import distortion
from edge.geometry.camera import CameraModel
from edge.relocalise.features import Features
from edge.types import F32, F64

# No part of an image is used that is stretched more than this: the model folds back there.
_MOST_STRETCHED = 20.0


def magnification(camera: CameraModel, normalised: F64) -> F64:
    """Ideal pixels a raw pixel (n,), the root of the areas' ratio, at ideal points (n, 2)."""
    J = distortion.jacobian(camera.distortion_model, camera.distortion, normalised)
    area = np.abs(J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0])
    return 1.0 / np.sqrt(np.maximum(area, _MOST_STRETCHED**-2))


def lens_shifts(camera: CameraModel, here: F64, there: F64, config: RelocaliseConfig) -> F64:
    """Shift (n, 2, 2) [px] of each match by one sigma of the focal length and of distortion.

    here, there  (n, 2) ideal points, where the feature is and where the map's camera saw it.

    A wrong lens moves the feature here, and moved the point when the map was made: only the
    difference is left. Images that overlap at opposite borders suffer from it most.
    """
    shifts = np.empty((len(here), 2, 2))
    shifts[:, 0] = config.lens_focal_share * (here - there)
    share = config.lens_corner_share
    shifts[:, 1] = bent(camera, here, share) - bent(camera, there, share)
    return shifts * (camera.fx, camera.fy)


def read_at_once(features: Features, rows_turned_rad: F64, camera: CameraModel) -> Features:
    """Features where they were at the middle row's time, of an image read row after row.

    rows_turned_rad  (3,) how far the camera turned meanwhile, its own axes. In a fast turn rows are
    shifted against one another by several pixels, which a pose takes for a translation.
    """
    late = lateness(features.raw_pixels, camera)
    shift = turned_rows(camera.normalise(features.pixels.astype(np.float64)), rows_turned_rad)
    pixels = features.pixels - late[:, None] * shift * (camera.fx, camera.fy)
    return features._replace(pixels=pixels.astype(np.float32))


def lateness(raw: F64 | F32, camera: CameraModel) -> F64 | F32:
    """How much later than the middle row raw pixels (n, 2) were read, in parts of the readout."""
    return (raw[:, 1] + 0.5) / camera.height - 0.5


def turned_rows(ideal: F64, turned_rad: F64) -> F64:
    """Shift (n, 2) of ideal points (n, 2) by which the last row is late, if the first is not.

    turned_rad  (3,) how far the camera turned meanwhile, its own axes
    """
    wx, wy, wz = turned_rad
    x, y = ideal.T
    spin = wx * y - wy * x
    return np.stack((wz * y - wy + x * spin, wx - wz * x + y * spin), axis=1)


def bent(camera: CameraModel, ideal: F64, corner_share: float) -> F64:
    """Shift (n, 2) of ideal points by a bend that moves the raw image's corner by a share."""
    raw = camera.distort(ideal)
    corner2 = 0.25 * ((camera.width / camera.fx) ** 2 + (camera.height / camera.fy) ** 2)
    bend = corner_share * np.sum(raw**2, axis=1, keepdims=True) / corner2 * raw
    if camera.distortion_model == distortion.NONE:
        return np.asarray(bend)
    J = distortion.jacobian(camera.distortion_model, camera.distortion, ideal)
    determinant = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    determinant = np.maximum(determinant, _MOST_STRETCHED**-2)
    x = J[:, 1, 1] * bend[:, 0] - J[:, 0, 1] * bend[:, 1]
    y = J[:, 0, 0] * bend[:, 1] - J[:, 1, 0] * bend[:, 0]
    return np.asarray(np.stack((x, y), axis=1) / determinant[:, None])
