# SPDX-License-Identifier: Apache-2.0
"""Points that two maps of one frame both have: found by their looks and places, and made one."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.geometry import se3
from edge.tiles.reader import KeyframeFeatures, Map
from edge.types import F32, F64, I32, Mat4, Pinhole
from maps.content import Content
from maps.points import StoredPoints, viewing

_MIN_SCORE = 0.05  # of words: places that could be the same
_MAX_BITS = 50
_MAX_RATIO = 0.8
_MIN_MATCHES = 20  # of points, for two places to be the same
_PLACES = 3  # of the first map that each keyframe of the second is compared with
# The same corner: seen by each map where the other's point says, and both points in one place.
_MAX_OFF_PX = 3.0  # at octave 0
_MAX_CHI2 = 16.27  # of three degrees of freedom: 99.9 %

I64 = NDArray[np.int64]


class LookAlikes(NamedTuple):
    """Corners that look the same in a keyframe of each map."""

    keyframe: int  # of the first map
    first: I32  # (n,) features there
    second: I32  # (n,) features in the keyframe of the second


def look_alikes(a: Map, content: Content, k: int, most: int) -> list[LookAlikes]:
    """The keyframes of `a`, `most` of them, that show what keyframe `k` of `content` shows."""
    described = content.descriptions[k]
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    found = []
    for keyframe, score in zip(*a.bow.query(described.words, most), strict=True):
        if score < _MIN_SCORE:
            break
        there = a.features(int(keyframe))
        pairs = matcher.knnMatch(described.features.descriptors, there.descriptors, k=2)
        good = [
            (best.trainIdx, best.queryIdx)
            for best, *others in (pair for pair in pairs if pair)
            if best.distance < _MAX_BITS
            and (not others or best.distance < _MAX_RATIO * others[0].distance)
        ]
        if len(good) >= _MIN_MATCHES:
            first, second = np.array(good, np.int32).T
            found.append(LookAlikes(int(keyframe), first, second))
    return found


def shared_points(a: Map, content: Content, cameras: list[Pinhole]) -> I32:
    """Points of `a` and of `content` that are the same, (n, 2): each is there once at most.

    cameras : of `content`, by the number that its views have
    """
    scale = a.manifest.extractor.scale_factor
    pairs = [np.empty((0, 2), np.int64)]
    for k, view in enumerate(content.views):
        features = content.descriptions[k].features
        own = KeyframeFeatures(
            features.pixels, features.descriptors, features.octave, features.angle_rad,
            content.points.point[k],
        )  # fmt: skip
        for alike in look_alikes(a, content, k, _PLACES):
            there = a.features(alike.keyframe)
            first, second = there.point[alike.first], own.point[alike.second]
            known = a.points(first)
            xyz = content.points.xyz[second]
            covariance = known.covariance + _covariance(content.points.lower[second])
            pinhole = a.cameras[int(a.keyframe_camera[alike.keyframe])].pinhole
            same = _sees(a.pose(alike.keyframe), pinhole, there, alike.first, xyz, scale)
            same &= _sees(view.T_map_cam, cameras[view.camera], own, alike.second, known.xyz, scale)
            same &= _chi2(xyz - known.xyz, covariance) < _MAX_CHI2
            pairs.append(np.column_stack((first, second))[same].astype(np.int64))
    return _one_to_one(np.concatenate(pairs))


def with_shared_points(content: Content, pairs: I32) -> Content:
    """The content with each pair of its points (n, 2) as one, which takes the place of the first.

    How far errors of the two go together is not known, so that their mean is as uncertain as if
    they did wholly (covariance intersection).
    """
    points = content.points
    n = len(points.xyz)
    gone = np.zeros(n, bool)
    gone[pairs[:, 1]] = True
    rank = np.cumsum(~gone) - 1
    number = rank.copy()
    number[pairs[:, 1]] = rank[pairs[:, 0]]
    owner = number[np.repeat(np.arange(n), np.diff(points.offsets))]
    rows = np.lexsort((points.view, owner))
    joined = _means(points, pairs)
    left = joined._replace(
        **{name: getattr(joined, name)[~gone] for name in _OF_POINTS},
        offsets=np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=n - len(pairs)))]),
        view=points.view[rows],
        feature=points.feature[rows],
        stored=points.stored[rows],
        point=[number[point].astype(np.int32) for point in points.point],
    )
    poses = [view.T_map_cam for view in content.views]
    direction, half_angle = viewing(left.xyz, owner[rows], left.view, poses)
    changed = rank[pairs[:, 0]]
    left.direction[changed], left.half_angle_rad[changed] = direction[changed], half_angle[changed]
    views = np.arange(len(content.views), dtype=np.int32)
    points_left = np.where(gone, -1, rank).astype(np.int32)
    extra = {name: layer.kept(views, points_left) for name, layer in content.extra.items()}
    return content._replace(points=left, extra=extra)


_OF_POINTS = (
    "xyz", "lower", "parallax_rad", "direction", "half_angle_rad", "pixel_size", "n_views",
)  # fmt: skip


def _means(points: StoredPoints, pairs: I32) -> StoredPoints:
    """All points, with the means of the pairs in the place of each first."""
    first, second = pairs.T
    one, other = (np.linalg.inv(_covariance(points.lower[rows])) for rows in (first, second))
    covariance = np.linalg.inv(0.5 * (one + other))
    weighted = one @ points.xyz[first, :, None] + other @ points.xyz[second, :, None]
    joined = points._replace(**{name: getattr(points, name).copy() for name in _OF_POINTS})
    joined.xyz[first] = (0.5 * covariance @ weighted)[:, :, 0]
    joined.lower[first] = np.linalg.cholesky(covariance)[:, *np.tril_indices(3)]
    chord = np.linalg.norm(points.direction[first] - points.direction[second], axis=1)
    between = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
    widest = np.maximum(points.parallax_rad[first], points.parallax_rad[second])
    joined.parallax_rad[first] = np.maximum(widest, between)
    counts = points.n_views[first], points.n_views[second]
    log_size = counts[0] * np.log(points.pixel_size[first])
    log_size += counts[1] * np.log(points.pixel_size[second])
    joined.pixel_size[first] = np.exp(log_size / (counts[0] + counts[1]))
    joined.n_views[first] = counts[0] + counts[1]
    return joined


def _covariance(lower: F64) -> F64:
    """Covariances (n, 3, 3) of factors (n, 6), row by row."""
    L = np.zeros((len(lower), 3, 3))
    L[:, *np.tril_indices(3)] = lower
    covariance: F64 = L @ L.transpose(0, 2, 1)
    return covariance


def _sees(
    T_map_cam: Mat4,
    pinhole: Pinhole,
    features: KeyframeFeatures,
    rows: I32,
    xyz: F64,
    scale: float,
) -> NDArray[np.bool_]:
    """Whether a keyframe sees points (n, 3) where its features `rows` (n,) are."""
    local = se3.transform(se3.inverse(T_map_cam), xyz)
    ahead: NDArray[np.bool_] = local[:, 2] > 1e-6
    focal, centre = (pinhole.fx, pinhole.fy), (pinhole.cx, pinhole.cy)
    seen = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None] * focal + centre
    pixels: F32 = features.pixels[rows]
    off = np.linalg.norm(seen - pixels, axis=1)
    near: NDArray[np.bool_] = off < _MAX_OFF_PX * scale ** features.octave[rows].astype(np.float64)
    return ahead & near


def _chi2(off: F64, covariance: F64) -> F64:
    """Squared Mahalanobis lengths (n,)."""
    solved = np.linalg.solve(covariance, off[:, :, None])[:, :, 0]
    squares: F64 = np.einsum("ni,ni->n", off, solved)
    return squares


def _one_to_one(pairs: I64) -> I32:
    """The pairs that most keyframes found, each point in one of them only; by the first point."""
    found, votes = np.unique(pairs, axis=0, return_counts=True)
    used: tuple[set[int], set[int]] = set(), set()
    chosen = []
    for row in np.argsort(-votes, kind="stable"):
        first, second = found[row].tolist()
        if first not in used[0] and second not in used[1]:
            used[0].add(first)
            used[1].add(second)
            chosen.append((first, second))
    return np.array(sorted(chosen), np.int32).reshape(-1, 2)
