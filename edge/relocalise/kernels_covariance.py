# SPDX-License-Identifier: Apache-2.0
"""What errors that many matches share do to a pose."""

import math

import numpy as np

from edge.kernel import kernel
from edge.relocalise.kernels_pose import pixel_rows, projected_covariance, to_camera
from edge.types import F64, Pinhole


@kernel
def common_scatter(
    pixels: F64,
    xyz: F64,
    C: F64,
    variance: F64,
    use: F64,
    camera: Pinhole,
    R: F64,
    p: F64,
    cell_px: int,
    columns: int,
    rows: int,
    axis: F64,
    area_cells: int,
    lens: F64,
    S: F64,
    S_depth: F64,
    S_lens: F64,
    M: F64,
) -> int:
    """Overwrite S with the scatter of J^T W e for a shift e of one pixel a cell, either way.

    An error that all matches of an image cell share does not average away. With the normal
    matrix H, H^-1 S H^-1 is the covariance of the pose by shared shifts of one pixel.

    use  (n,)    float64  weight of each match, 0 to leave it out
    axis  (n, 3)  float64  one sigma of each point along the ray it was seen on [m]
    area_cells   points in areas of so many cells squared are wrong together along their rays
    lens  (n, k, 2)  float64  shift of each match by one sigma of k parameters of the lens [px]
    S        (6, 6)  float64, out
    S_depth  (6, 6)  float64, out  the same of J^T W e for points one sigma off along their rays
    S_lens   (6, 6)  float64, out  and for a lens one sigma off in each parameter
    M    (columns * rows, 3)  float64, out  of each cell: its mean residual u, v [px], and the
         variance [px^2] that independent errors would leave in such a mean; infinite if unused

    Returns how many cells are used.
    """
    G = np.zeros((columns * rows, 2, 6))
    count = np.zeros(columns * rows)
    area_columns = (columns + area_cells - 1) // area_cells
    D = np.zeros((area_columns * ((rows + area_cells - 1) // area_cells), 6))
    B = np.zeros((lens.shape[1], 6))
    M[:, :] = 0.0
    for i in range(pixels.shape[0]):
        if use[i] == 0.0:
            continue
        x, y, z = to_camera(R, p, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        u0, u1, u2, v0, v1, v2 = pixel_rows(camera, R, x, y, z)
        suu, suv, svv = projected_covariance(C, i, u0, u1, u2, v0, v1, v2)
        suu, svv = suu + variance[i], svv + variance[i]
        determinant = suu * svv - suv * suv
        wuu, wuv, wvv = svv / determinant, -suv / determinant, suu / determinant
        dx, dy, dz = xyz[i, 0] - p[0], xyz[i, 1] - p[1], xyz[i, 2] - p[2]
        Ju = (-u0, -u1, -u2, u1 * dz - u2 * dy, u2 * dx - u0 * dz, u0 * dy - u1 * dx)
        Jv = (-v0, -v1, -v2, v1 * dz - v2 * dy, v2 * dx - v0 * dz, v0 * dy - v1 * dx)
        cx = min(max(int(pixels[i, 0]) // cell_px, 0), columns - 1)
        cy = min(max(int(pixels[i, 1]) // cell_px, 0), rows - 1)
        cell = cy * columns + cx
        count[cell] += 1.0
        M[cell, 0] += pixels[i, 0] - camera.fx * x / z - camera.cx
        M[cell, 1] += pixels[i, 1] - camera.fy * y / z - camera.cy
        M[cell, 2] += 0.5 * (suu + svv)
        # The image moves with the point: u0 u1 u2 are the pixel's derivatives by it.
        eu = u0 * axis[i, 0] + u1 * axis[i, 1] + u2 * axis[i, 2]
        ev = v0 * axis[i, 0] + v1 * axis[i, 1] + v2 * axis[i, 2]
        area = (cy // area_cells) * area_columns + cx // area_cells
        for k in range(B.shape[0]):
            lu = wuu * lens[i, k, 0] + wuv * lens[i, k, 1]
            lv = wuv * lens[i, k, 0] + wvv * lens[i, k, 1]
            for r in range(6):
                B[k, r] += use[i] * (Ju[r] * lu + Jv[r] * lv)
        for r in range(6):
            D[area, r] += use[i] * (Ju[r] * (wuu * eu + wuv * ev) + Jv[r] * (wuv * eu + wvv * ev))
            G[cell, 0, r] += use[i] * (Ju[r] * wuu + Jv[r] * wuv)
            G[cell, 1, r] += use[i] * (Ju[r] * wuv + Jv[r] * wvv)
    S[:, :] = 0.0
    S_depth[:, :] = 0.0
    S_lens[:, :] = 0.0
    for k in range(B.shape[0]):
        for r in range(6):
            for c in range(6):
                S_lens[r, c] += B[k, r] * B[k, c]
    for area in range(D.shape[0]):
        for r in range(6):
            for c in range(6):
                S_depth[r, c] += D[area, r] * D[area, c]
    used = 0
    for cell in range(columns * rows):
        if count[cell] == 0.0:
            M[cell, 2] = np.inf
            continue
        used += 1
        M[cell, 0] /= count[cell]
        M[cell, 1] /= count[cell]
        M[cell, 2] /= count[cell] * count[cell]
        for r in range(6):
            for c in range(6):
                S[r, c] += G[cell, 0, r] * G[cell, 0, c] + G[cell, 1, r] * G[cell, 1, c]
    return used


@kernel
def spread(pixels: F64, use: F64) -> float:
    """Standard deviation [px] of the used pixels (n, 2) along their narrowest axis."""
    n, mu, mv, uu, uv, vv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(pixels.shape[0]):
        n += use[i]
        mu += use[i] * pixels[i, 0]
        mv += use[i] * pixels[i, 1]
    if n == 0.0:
        return 0.0
    mu, mv = mu / n, mv / n
    for i in range(pixels.shape[0]):
        du, dv = pixels[i, 0] - mu, pixels[i, 1] - mv
        uu += use[i] * du * du
        uv += use[i] * du * dv
        vv += use[i] * dv * dv
    half = math.hypot(0.5 * (uu - vv), uv)
    return math.sqrt(max(0.0, (0.5 * (uu + vv) - half) / n))
