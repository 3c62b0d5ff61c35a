# SPDX-License-Identifier: Apache-2.0
"""How well a pose explains 2D-3D matches, wrong ones among them."""

import math

from edge.kernel import kernel
from edge.relocalise.kernels_pose import MIN_DEPTH, to_camera
from edge.types import F64, Pinhole


@kernel
def likelihood_gain(
    pixels: F64,
    xyz: F64,
    C: F64,
    variance: F64,
    camera: Pinhole,
    R: F64,
    p: F64,
    clutter_px2: float,
    gate: float,
) -> float:
    """How much better a pose explains the matches than chance does: sum of log ratios.

    A right match is normal about the projection, a wrong one lies anywhere in `clutter_px2`. The
    projected covariance is taken as round here, for this is called for every hypothesis.

    pixels    (n, 2)  float64
    xyz       (n, 3)  float64  map points
    C         (n, 6)  float64  their covariance: xx xy xz yy yz zz
    variance  (n,)    float64  of a pixel [px^2]
    R, p      (3, 3), (3,)     R_map_cam and position of the camera
    gate      squared Mahalanobis distance beyond which a match counts as wrong
    """
    total = 0.0
    for i in range(pixels.shape[0]):
        x, y, z = to_camera(R, p, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        if z < MIN_DEPTH:
            continue
        du = camera.fx * x / z + camera.cx - pixels[i, 0]
        dv = camera.fy * y / z + camera.cy - pixels[i, 1]
        dx, dy, dz = xyz[i, 0] - p[0], xyz[i, 1] - p[1], xyz[i, 2] - p[2]
        square = dx * dx + dy * dy + dz * dz
        along = (
            dx * (C[i, 0] * dx + 2.0 * (C[i, 1] * dy + C[i, 2] * dz))
            + dy * (C[i, 3] * dy + 2.0 * C[i, 4] * dz)
            + C[i, 5] * dz * dz
        ) / square
        across = 0.5 * (C[i, 0] + C[i, 3] + C[i, 5] - along)
        s2 = variance[i] + camera.fx * camera.fx * across / (z * z)
        m2 = (du * du + dv * dv) / s2
        if m2 < gate:
            best = min(math.log(clutter_px2 / (2.0 * math.pi * s2)), 0.5 * gate)
            total += max(0.0, best - 0.5 * m2)
    return total
