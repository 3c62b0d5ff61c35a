# SPDX-License-Identifier: Apache-2.0
"""Where map points should appear from a pose, with all uncertainty projected."""

import math

from edge.kernel import kernel
from edge.relocalise.kernels_pose import MIN_DEPTH, pixel_rows, projected_covariance, to_camera
from edge.types import F32, F64, I32, Pinhole


@kernel
def project_points(
    xyz: F64,
    C: F64,
    R: F64,
    p: F64,
    P: F64,
    camera: Pinhole,
    border_px: float,
    sigmas: float,
    least_px: float,
    greatest_px: float,
    centre: F64,
    depth: F64,
    sigma_px: F64,
    window: F64,
) -> None:
    """Project points (n) into a camera at R, p with covariance P.

    C         (n, 6)  float64  xx xy xz yy yz zz
    P         (6, 6)  float64  of the camera's position and rotation, map axes
    sigmas    half width of a window in sigmas, but at least `least_px`
    centre    (n, 2)  float64, out
    depth     (n,)    float64, out  not positive behind the camera
    sigma_px  (n,)    float64, out  along the longest axis
    window    (n,)    float64, out  0 outside the image, or where it were beyond `greatest_px`
    """
    far_u, far_v = camera.width - 1 - border_px, camera.height - 1 - border_px
    for i in range(xyz.shape[0]):
        x, y, z = to_camera(R, p, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        depth[i], window[i], sigma_px[i] = z, 0.0, 0.0
        iz = 1.0 / z if z > MIN_DEPTH else 1.0
        u, v = camera.fx * x * iz + camera.cx, camera.fy * y * iz + camera.cy
        centre[i, 0], centre[i, 1] = u, v
        if z <= MIN_DEPTH or u < border_px or u > far_u or v < border_px or v > far_v:
            continue
        u0, u1, u2, v0, v1, v2 = pixel_rows(camera, R, x, y, z)
        suu, suv, svv = projected_covariance(C, i, u0, u1, u2, v0, v1, v2)
        dx, dy, dz = xyz[i, 0] - p[0], xyz[i, 1] - p[1], xyz[i, 2] - p[2]
        # The pixel moves against the camera: by -v - w x ray.
        Ju = (-u0, -u1, -u2, u1 * dz - u2 * dy, u2 * dx - u0 * dz, u0 * dy - u1 * dx)
        Jv = (-v0, -v1, -v2, v1 * dz - v2 * dy, v2 * dx - v0 * dz, v0 * dy - v1 * dx)
        for r in range(6):
            for c in range(6):
                suu += Ju[r] * P[r, c] * Ju[c]
                suv += Ju[r] * P[r, c] * Jv[c]
                svv += Jv[r] * P[r, c] * Jv[c]
        half = math.hypot(0.5 * (suu - svv), suv)
        sigma_px[i] = math.sqrt(max(0.5 * (suu + svv) + half, 0.0))
        wide = max(least_px, sigmas * sigma_px[i])
        if wide <= greatest_px:
            window[i] = wide


@kernel
def project_rows(
    xyz: F64,
    p: F64,
    point: I32,
    ray: F64,
    pixel_m: F64,
    depth: F64,
    window: F64,
    stretch: F64,
    focal_px: float,
    log_scale_factor: float,
    least_cosine: float,
    level: F32,
    radius_px: F64,
) -> None:
    """Windows of the rows (m), each a view of a point from one keyframe.

    point      (m,)    int32    which point
    ray        (m, 3)  float64  unit vector on which it was seen
    pixel_m    (m,)    float64  length at the point of one raw pixel of that view's level
    stretch    (n,)    float64  ideal pixels a raw pixel, where the point appears
    level      (m,)    float32, out  octave at which its patch should appear
    radius_px  (m,)    float64, out  0 where the row should not be seen
    """
    for k in range(point.shape[0]):
        i = point[k]
        level[k], radius_px[k] = 0.0, 0.0
        if window[i] == 0.0:
            continue
        dx, dy, dz = xyz[i, 0] - p[0], xyz[i, 1] - p[1], xyz[i, 2] - p[2]
        facing = dx * ray[k, 0] + dy * ray[k, 1] + dz * ray[k, 2]
        if facing < least_cosine * math.sqrt(dx * dx + dy * dy + dz * dz):
            continue
        pixels = pixel_m[k] * focal_px / depth[i]
        level[k] = math.log(max(pixels / stretch[i], 1e-3)) / log_scale_factor
        # Features of a higher octave are placed less exactly, and so are stretched ones.
        radius_px[k] = window[i] * max(stretch[i], pixels)
