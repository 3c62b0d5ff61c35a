# SPDX-License-Identifier: Apache-2.0
"""Lines in space from segments seen in two or more views, and where along them they were seen."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge.lines import kernels_structure
from edge.lines.line import Lines, Segments, ends, plane_normals
from edge.types import F64, Mat4, Pinhole

_STEPS = 15
# Planes must spread so much more than the noise of their segments turns them.
_MIN_SPREAD_SIGMAS = 5.0
# Median squared distance of views beyond which they do not agree on any line.
_AGREE = 9.0


class Views(NamedTuple):
    """The segments that show one line, each with its camera's pose."""

    segments: Segments  # (m,)
    T_cam_lines: F64  # (m, 4, 4)


class Structure(NamedTuple):
    """Lines in space and how well their views agree on them."""

    lines: Lines
    span: F64  # (n, 2) first and last place that was seen, from the line's point, along it
    m2: tuple[F64, ...]  # of each line: (m,) squared distances of its views, two freedoms each
    known: np.ndarray[tuple[int], np.dtype[np.bool_]]  # (n,) False where views leave a line open


def views_of(seen: Sequence[tuple[Segments, int, Mat4]]) -> Views:
    """Views from pairs of an image's segments and the index of one of them, with poses."""
    rows = [[np.asarray(array)[k] for array in segments] for segments, k, _ in seen]
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Views(Segments(*columns), np.array([T for _, _, T in seen]))


def triangulate(views: Sequence[Views], camera: Pinhole, cauchy2: float = 9.0) -> Structure:
    """Lines from their views: linear first, then at the least distance in all images.

    The planes through each camera's centre and its segment meet in the line (Hartley and
    Zisserman 2004, 12.7). Each line has at least two views; whether they really tell one is said
    by `known` and by its covariance.
    """
    linear = [_meet(view, camera) for view in views]
    point = np.array([line[0] for line in linear]).reshape(-1, 3)
    direction = np.array([line[1] for line in linear]).reshape(-1, 3)
    start = np.cumsum([0] + [len(view.segments.length) for view in views]).astype(np.int32)
    covariance, m2 = np.empty((len(views), 4, 4)), np.empty(start[-1])
    if views:
        columns = [np.concatenate(c) for c in zip(*(v.segments for v in views), strict=True)]
        T = np.concatenate([view.T_cam_lines for view in views])
        kernels_structure.refine(
            start, columns[0], columns[1], columns[2], columns[3], T, camera, cauchy2, _STEPS,
            point, direction, covariance, m2,
        )  # fmt: skip
    lines = Lines(point, direction, covariance)
    spans = [_span(view, p, d, camera) for view, p, d in zip(views, point, direction, strict=True)]
    span = np.array(spans).reshape(-1, 2)
    each = tuple(np.split(m2, start[1:-1])) if views else ()
    agree = [bool(np.median(distances) < _AGREE) for distances in each]
    known = np.array([line[2] for line in linear], np.bool_) & np.array(agree, np.bool_)
    return Structure(lines, span, each, known)


def _meet(views: Views, camera: Pinhole) -> tuple[F64, F64, bool]:
    """Point and direction where the planes of all views meet, and whether they do."""
    R, t = views.T_cam_lines[:, :3, :3], views.T_cam_lines[:, :3, 3]
    normals = np.einsum("mji,mj->mi", R, plane_normals(views.segments, camera))
    centres = -np.einsum("mji,mj->mi", R, t)
    values, vectors = np.linalg.eigh(normals.T @ normals)
    direction = vectors[:, 0]
    # The place along the line is that of the first view's middle: it alone was surely seen.
    ray = R[0].T @ _rays(views.segments.middle[:1], camera)[0]
    side = np.cross(direction, np.cross(ray, direction))
    offsets = np.sum(normals * centres, axis=1)
    A, b = normals, offsets
    across_first = vectors[:, 1:]
    foot = across_first @ np.linalg.lstsq(A @ across_first, b, rcond=None)[0]
    along_ray = (foot - centres[0]) @ side / max(float(ray @ side), 1e-12)
    point = foot + ((centres[0] + along_ray * ray - foot) @ direction) * direction
    is_ahead = bool(along_ray > 0.0)
    # A segment's own turn moves its plane's normal by no more than that turn.
    turns = np.sqrt(2.0) * views.segments.sigma / views.segments.length
    spread = np.sqrt(max(float(values[1]), 0.0) / float(np.sum(turns**2) + 1e-24))
    return point, direction, bool(spread > _MIN_SPREAD_SIGMAS) and is_ahead


def _span(views: Views, point: F64, direction: F64, camera: Pinhole) -> tuple[float, float]:
    """First and last place along a line where the rays of segments' ends come nearest to it."""
    R, t = views.T_cam_lines[:, :3, :3], views.T_cam_lines[:, :3, 3]
    places = []
    for pixels in np.split(ends(views.segments), 2, axis=1):
        rays = np.einsum("mji,mj->mi", R, _rays(pixels, camera))
        away = -np.einsum("mji,mj->mi", R, t) - point
        # Nearest points of two lines: the ray's share along the line is taken out first.
        cosine = rays @ direction
        across = rays - cosine[:, None] * direction
        s = -np.sum(across * away, axis=1) / np.maximum(np.sum(across**2, axis=1), 1e-12)
        places.append(away @ direction + s * cosine)
    # Medians of the outer halves: one view whose segment ran too far does not stretch it.
    low, high = np.minimum(*places), np.maximum(*places)
    return float(np.quantile(low, 0.25)), float(np.quantile(high, 0.75))


def _rays(pixels: F64, camera: Pinhole) -> F64:
    """Unit rays (m, 3) of pixels (m, 2), in the camera's frame."""
    rays = np.column_stack(
        (
            (pixels[:, 0] - camera.cx) / camera.fx,
            (pixels[:, 1] - camera.cy) / camera.fy,
            np.ones(len(pixels)),
        )
    )
    unit: F64 = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit
