# SPDX-License-Identifier: Apache-2.0
"""Sparse depths of laser points made dense by a bilateral filter."""

import math

import numpy as np

from edge.kernel import kernel

_MAX_SAMPLES = 512  # of a window
_MIN_SAMPLES = 3
_GAP = 0.08  # relative step between sorted inverse depths that parts two surfaces
_RANGE_SIGMA = 0.10  # relative deviation of inverse depths that belong together
_MIN_SPREAD_PX = 0.5  # of samples across a direction, for a slope to be known


@kernel
def splat(u, v, z, out):  # type: ignore[no-untyped-def]
    """Write the nearest of the depths that fall on each pixel.

    u, v, z  (n,)    float64  pixels and depths
    out      (h, w)  float32, out  0 where none falls
    """
    height, width = out.shape
    out[:] = 0.0
    for i in range(len(z)):
        x, y = math.floor(u[i] + 0.5), math.floor(v[i] + 0.5)
        if 0 <= x < width and 0 <= y < height and (out[y, x] == 0.0 or z[i] < out[y, x]):
            out[y, x] = z[i]


@kernel
def densify(sparse, radius, out):  # type: ignore[no-untyped-def]
    """Fill in each pixel from the laser points around it that lie on one surface.

    Samples are weighed by their distance in the image and in range (Premebida et al. 2016). Where
    they fall into a near and a far surface, the one that weighs more counts alone. Inverse depth
    is linear over a plane, so a slope is fitted with these weights instead of a mean.

    sparse  (h, w)  float32  depths, 0 where there is none
    radius  int     half the side of the window [px]
    out     (h, w)  float32, out  0 where too few points are near, or on one side only
    """
    height, width = sparse.shape
    du, dv = np.empty(_MAX_SAMPLES), np.empty(_MAX_SAMPLES)
    rho, near = np.empty(_MAX_SAMPLES), np.empty(_MAX_SAMPLES)
    order = np.empty(_MAX_SAMPLES, np.int64)
    spread2 = 2.0 * (0.5 * radius) ** 2
    for y in range(height):
        for x in range(width):
            out[y, x] = 0.0
            n, nearest = 0, 1e9
            for j in range(max(0, y - radius), min(height, y + radius + 1)):
                for i in range(max(0, x - radius), min(width, x + radius + 1)):
                    if sparse[j, i] > 0.0 and n < _MAX_SAMPLES:
                        du[n], dv[n], rho[n] = i - x, j - y, 1.0 / sparse[j, i]
                        distance2 = du[n] ** 2 + dv[n] ** 2
                        near[n] = math.exp(-distance2 / spread2)
                        nearest = min(nearest, distance2)
                        n += 1
            if n < _MIN_SAMPLES or nearest > (0.7 * radius) ** 2:
                continue
            middle = _surface(rho, near, n, order)
            value = _fit(du, dv, rho, near, n, middle)
            if value > 0.0:
                out[y, x] = 1.0 / value


@kernel
def _surface(rho, near, n, order):  # type: ignore[no-untyped-def]
    """Inverse depth of the surface that weighs most: parted at the widest gap, if it is wide."""
    for k in range(n):  # few: insertion is the quickest
        place = k
        while place > 0 and rho[order[place - 1]] > rho[k]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = k
    cut, widest = 0, _GAP
    for k in range(1, n):
        step = (rho[order[k]] - rho[order[k - 1]]) / rho[order[k]]
        if step > widest:
            cut, widest = k, step
    begin, end = 0, n
    if cut > 0:
        below = above = 0.0
        for k in range(n):
            if k < cut:
                below += near[order[k]]
            else:
                above += near[order[k]]
        if below > above:
            end = cut
        else:
            begin = cut
    total = weight = 0.0
    for k in range(begin, end):
        total += near[order[k]] * rho[order[k]]
        weight += near[order[k]]
    return total / weight


@kernel
def _fit(du, dv, rho, near, n, middle):  # type: ignore[no-untyped-def]
    """Inverse depth in the middle of the window, of a plane through those near `middle`."""
    w = wx = wy = wxx = wxy = wyy = wr = wxr = wyr = 0.0
    count = 0
    left, right, above, below = False, False, False, False
    for i in range(n):
        off = (rho[i] - middle) / (_RANGE_SIGMA * middle)
        if abs(off) > 2.5:
            continue
        weight = near[i] * math.exp(-0.5 * off * off)
        x, y = du[i], dv[i]
        w += weight
        wx, wy, wr = wx + weight * x, wy + weight * y, wr + weight * rho[i]
        wxx, wxy, wyy = wxx + weight * x * x, wxy + weight * x * y, wyy + weight * y * y
        wxr, wyr = wxr + weight * x * rho[i], wyr + weight * y * rho[i]
        left, right = left or x <= 0, right or x >= 0
        above, below = above or y <= 0, below or y >= 0
        count += 1
    if count < _MIN_SAMPLES or not (left and right and above and below):
        return 0.0
    mx, my, mr = wx / w, wy / w, wr / w
    cxx, cxy, cyy = wxx / w - mx * mx, wxy / w - mx * my, wyy / w - my * my
    cxr, cyr = wxr / w - mx * mr, wyr / w - my * mr
    least = _MIN_SPREAD_PX**2
    determinant = cxx * cyy - cxy * cxy
    if determinant > least * max(cxx, cyy):
        gx = (cxr * cyy - cyr * cxy) / determinant
        gy = (cyr * cxx - cxr * cxy) / determinant
    elif cxx > cyy and cxx > least:
        gx, gy = cxr / cxx, 0.0
    elif cyy > least:
        gx, gy = 0.0, cyr / cyy
    else:
        gx = gy = 0.0
    value = mr - gx * mx - gy * my
    # A slope must not lead away from what was measured.
    return value if abs(value - middle) < 2.5 * _RANGE_SIGMA * middle else 0.0
