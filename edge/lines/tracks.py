# SPDX-License-Identifier: Apache-2.0
"""Segments followed from image to image of known pose, until they tell lines in space."""

import numpy as np

from edge.config.lines import SegmentTracksConfig
from edge.lines import kernels_associate
from edge.lines.line import Lines, Segments, ends
from edge.lines.structure import Structure, Views, triangulate, views_of
from edge.types import F64, I32, Bools, Mat4, Pinhole

_MIN_SHARE = 0.5  # of a segment's samples that must meet the next one


class SegmentTracks:
    """Chains of segments that show the same edge in images that follow each other.

    Owned by one thread.
    """

    def __init__(self, camera: Pinhole, config: SegmentTracksConfig) -> None:
        self._camera, self._config = camera, config
        self._seen: list[list[tuple[Segments, int, Mat4]]] = []  # of each track
        self._last: tuple[Segments, Mat4, list[int]] | None = None  # and the segments' tracks

    def step(self, segments: Segments, T_cam_lines: Mat4) -> None:
        """Add the segments of the next image and its pose."""
        tracks = [-1] * len(segments.length)
        if self._last is not None:
            before, T_before, tracks_before = self._last
            turn = T_cam_lines[:3, :3] @ T_before[:3, :3].T
            for old, new in self._followed(before, turn, segments):
                tracks[new] = tracks_before[old]
        for k, track in enumerate(tracks):
            if track < 0:
                tracks[k] = len(self._seen)
                self._seen.append([])
            self._seen[tracks[k]].append((segments, k, T_cam_lines))
        self._last = (segments, T_cam_lines, tracks)

    def structure(self) -> Structure:
        """Lines that enough views agree on."""
        long = [seen for seen in self._seen if len(seen) >= self._config.min_views]
        return _known(triangulate([views_of(seen) for seen in long], self._camera))

    def views(self) -> list[Views]:
        """The views of each track so far, short ones too."""
        return [views_of(seen) for seen in self._seen]

    def _followed(self, before: Segments, turn: F64, now: Segments) -> list[tuple[int, int]]:
        """Pairs of segments that follow each other, one to one."""
        places = _turned(before, turn, self._camera)
        n = len(places)
        match, share, offset = np.empty(n, np.int32), np.empty(n), np.empty(n)
        cosine = float(np.cos(np.deg2rad(self._config.angle_deg)))
        reach = np.full(n, self._config.reach_px)
        # The brighter side stays on the same hand: the other edge of a batten is no successor.
        kernels_associate.vote(places, reach, *now[:3], cosine, True, match, share, offset)
        found = np.flatnonzero((match >= 0) & (share >= _MIN_SHARE))
        return _one_to_one(found, match, np.abs(offset))


def _turned(segments: Segments, turn: F64, camera: Pinhole) -> F64:
    """Where ends (n, 4) go when the camera turns by R (3, 3); NaN if behind it."""
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    places = []
    for pixels in np.split(ends(segments), 2, axis=1):
        rays = np.column_stack(((pixels - centre) / focal, np.ones(len(pixels)))) @ turn.T
        rays[rays[:, 2] < 0.1] = np.nan
        places.append(rays[:, :2] / rays[:, 2:] * focal + centre)
    return np.hstack(places)


def _one_to_one(found: I32 | np.ndarray, match: I32, distance: F64) -> list[tuple[int, int]]:
    order = found[np.argsort(distance[found], kind="stable")]
    targets, first = np.unique(match[order], return_index=True)
    return [(int(order[k]), int(target)) for target, k in zip(targets, first, strict=True)]


def _known(found: Structure) -> Structure:
    chosen: Bools = found.known
    lines = Lines(*(array[chosen] for array in found.lines))
    each = tuple(m2 for m2, good in zip(found.m2, chosen, strict=True) if good)
    return Structure(lines, found.span[chosen], each, chosen[chosen])
