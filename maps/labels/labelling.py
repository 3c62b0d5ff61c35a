# SPDX-License-Identifier: Apache-2.0
"""Makes labels of what a segmentation model saw in the images of a map."""

from typing import NamedTuple

import cv2
import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.changes.cover import holds
from edge.changes.glimpse import Ranger, glimpses
from edge.geometry import se3
from edge.types import F32, F64, I32, Detections, Mask, Mat4
from maps.describe import Description
from maps.labels.layer import LabelSet, Seen
from maps.labels.looking import Sightings
from maps.labels.objects import View, group_objects
from maps.labels.portraits import portray
from maps.labels.votes import LabelVotes
from maps.points import StoredPoints
from maps.views import ViewSet

_MIN_KNOWN = 2  # points in a mask, to tell its distance
_EDGE_PX = 4  # of a mask, that may be beside the thing
_DEPTH_SIGMA = 0.1  # of it, as the median of points says
_DEPTH_STEP = 8  # of a depth image that tells what hides what [px]


class _Image(NamedTuple):
    """One image of the map, and what the model saw in it."""

    detections: Detections
    depth_m: F32 | None  # (h, w), 0 where unknown


def label(
    sightings: Sightings, chosen: ViewSet, descriptions: list[Description], stored: StoredPoints
) -> LabelSet:
    """The labels of a map, from what a model saw in its images."""
    recordings = [open_recording(root) for root in chosen.roots]
    votes = LabelVotes(len(stored.xyz), len(sightings.entry.names))
    views, seen = [], []
    for k, taken in enumerate(chosen.views):
        weak, strong = sightings.weak(k), sightings.strong(k)
        seen.append(Seen(weak.boxes, weak.classes, weak.scores))
        depth = _depth(recordings[taken.sequence], chosen, taken.sequence, taken.image)
        view = _view(k, chosen, descriptions[k], stored, _Image(strong, depth))
        votes.add(view.points, view.pixels, strong)
        views.append(view)
    objects = portray(
        group_objects(views),
        [view.T_map_cam for view in views],
        [view.camera for view in views],
        lambda k: recordings[chosen.views[k].sequence].image(chosen.views[k].image),
    )
    return LabelSet(sightings.entry, votes.count(), seen, objects)


def _depth(recording: Recording, chosen: ViewSet, sequence: int, image: int) -> F32 | None:
    depth = recording.depth(image)
    if depth is None or not chosen.origin.depth_scale:
        return depth
    scaled: F32 = depth * np.float32(chosen.origin.depth_scale[sequence])
    return scaled


def _view(
    k: int, chosen: ViewSet, described: Description, stored: StoredPoints, image: _Image
) -> View:
    taken = chosen.views[k]
    camera, T_map_cam = chosen.cameras[taken.camera], taken.T_map_cam
    points: I32 = stored.point[k]
    pixels = described.features.raw_pixels[stored.features[k]]
    depth = _depths(stored.xyz[points], T_map_cam)
    if image.depth_m is None:
        ranger = _by_points(pixels, depth)
        surface_pixels, surface = pixels, depth
    else:
        ranger = _by_image(image.depth_m)
        surface_pixels, surface = _sampled(image.depth_m)
    lines = glimpses(image.detections, T_map_cam, camera, ranger)
    return View(points, pixels, T_map_cam, camera, image.detections, lines, surface_pixels, surface)


def _depths(xyz: F64, T_map_cam: Mat4) -> F64:
    depth: F64 = se3.transform(se3.inverse(T_map_cam), xyz)[:, 2]
    return depth


def _by_points(pixels: F32, depth_m: F64) -> Ranger:
    def ranger(mask: Mask) -> tuple[float, float]:
        inside = depth_m[holds(_inner(mask), pixels)]
        if len(inside) < _MIN_KNOWN:
            return float("nan"), float("nan")
        middle = float(np.median(inside))
        return middle, _DEPTH_SIGMA * middle

    return ranger


def _inner(mask: Mask) -> Mask:
    """The mask without its edge, where points of what is behind lie under it."""
    size = np.ones((2 * _EDGE_PX + 1, 2 * _EDGE_PX + 1), np.uint8)
    inner = cv2.erode(np.pad(mask.inside.astype(np.uint8), 1), size)[1:-1, 1:-1]
    return mask._replace(inside=inner > 0)


def _by_image(depth_m: F32) -> Ranger:
    def ranger(mask: Mask) -> tuple[float, float]:
        h, w = mask.inside.shape
        part = depth_m[mask.top : mask.top + h, mask.left : mask.left + w]
        known = part[mask.inside & (part > 0.0)]
        if len(known) == 0:
            return float("nan"), float("nan")
        middle = float(np.median(known))
        return middle, 0.5 * float(np.percentile(known, 75) - np.percentile(known, 25)) + 0.01

    return ranger


def _sampled(depth_m: F32) -> tuple[F32, F64]:
    rows, columns = np.mgrid[0 : depth_m.shape[0] : _DEPTH_STEP, 0 : depth_m.shape[1] : _DEPTH_STEP]
    depth = depth_m[rows, columns]
    known = depth > 0.0
    pixels = np.stack([columns[known], rows[known]], axis=1).astype(np.float32)
    return pixels, depth[known].astype(np.float64)
