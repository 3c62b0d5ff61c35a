# SPDX-License-Identifier: Apache-2.0
"""Poses and metres from square markers that the configuration knows."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from edge.config.markers import MarkersConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.markers.finder import MarkerFinder
from edge.markers.pose import MarkerPose, believed, corner_points, joint_poses, poses
from edge.types import F64, DepthSamples, Fix, Mat4, Mat6, Query

_REACH = 0.65  # of the side, from the middle: the frame's outer edge has depths, too
_MIN_SAMPLES = 4
_MIN_INVERSE = 1e-9
# Depths of one window are wrong together by so much, and so many of their own sigmas.
_COMMON_LOG_SCALE, _COMMON_SIGMAS = 0.04, 3.0


class _Seen(NamedTuple):
    """A known marker in one image."""

    number: int
    corners: F64  # (4, 2) ideal px
    side_m: float
    T_map_marker: Mat4 | None
    found: list[MarkerPose]


class MarkerFixes:
    """Finds known markers in queries. Owned by the relocaliser's thread."""

    def __init__(self, camera: CameraModel, config: MarkersConfig, *, has_map: bool) -> None:
        self._camera, self._pinhole, self._config = camera, camera.pinhole, config
        self._finder = MarkerFinder(config.family)
        self._places: dict[int, tuple[float, Mat4 | None]] = {}
        for place in config.known:
            T = None
            if place.position_m is not None:
                T = se3.from_quaternion_translation(place.rotation_xyzw, place.position_m)
            elif not has_map and not self._places:
                T = np.eye(4)
            self._places[place.number] = (place.side_m or config.side_m, T)

    def fix(self, query: Query) -> tuple[Fix | None, tuple[float, float] | None]:
        """Fix by markers whose place is known, and what all tell of the scale: ln and its sigma."""
        seen = self._seen(query)
        scale = None if query.depth is None else self._log_scale(seen, query.depth)
        placed = [marker for marker in seen if marker.T_map_marker is not None]
        best = self._pose(placed)
        if best is None:
            return None, scale
        T_map_cam = se3.inverse(best.T_cam_marker)
        distance = float(np.median([_distance(T_map_cam, marker) for marker in placed]))
        covariance = self._covariance(best, T_map_cam, distance)
        for array in (T_map_cam, covariance):
            array.flags.writeable = False
        frame = query.frame
        fix = Fix(
            frame.index,
            frame.t_ns,
            query.odom_id,
            query.T_odom_cam,
            True,
            "ok",
            matches=4 * len(placed),
            inliers=4 * len(placed),
            T_map_cam=T_map_cam,
            covariance=covariance,
            log_scale=None if scale is None else scale[0],
            log_scale_sigma=None if scale is None else scale[1],
            depth_m=distance,
        )
        return fix, scale

    def _seen(self, query: Query) -> list[_Seen]:
        seen = []
        for marker in self._finder.find(query.frame.image):
            if marker.number not in self._places:
                continue
            side_m, T = self._places[marker.number]
            corners = self._camera.undistort_pixels(marker.corners)
            if not np.isfinite(corners).all():
                continue
            found = poses(corners, side_m, self._pinhole, self._config.corner_px)
            seen.append(_Seen(marker.number, corners, side_m, T, found))
        return sorted(seen, key=lambda marker: marker.number)

    def _pose(self, placed: Sequence[_Seen]) -> MarkerPose | None:
        """T_cam_map, if no other pose explains the corners of all markers nearly as well."""
        if not placed:
            return None
        points, corners, starts = [], [], []
        for marker in placed:
            assert marker.T_map_marker is not None
            points.append(se3.transform(marker.T_map_marker, corner_points(marker.side_m)))
            corners.append(marker.corners)
            T_marker_map = se3.inverse(marker.T_map_marker)
            starts += [pose.T_cam_marker @ T_marker_map for pose in marker.found]
        found = joint_poses(
            np.concatenate(points), np.concatenate(corners), starts, self._pinhole,
            self._config.corner_px,
        )  # fmt: skip
        return believed(found, len(placed))

    def _covariance(self, best: MarkerPose, T_map_cam: Mat4, distance: float) -> Mat6:
        """Of position and rotation, map axes; what survey and print err by is in it."""
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = -T_map_cam[:3, :3]
        config = self._config
        tilt = math.radians(config.survey_deg)
        # A sheet turned by its survey carries the camera with it, at the lever of the distance.
        length2 = (config.side_share * distance) ** 2 + config.survey_m**2 + (tilt * distance) ** 2
        floor = np.diag(np.repeat((length2, tilt**2), 3))
        return np.asarray(turn @ best.covariance @ turn.T + floor, np.float64)

    def _log_scale(self, seen: Sequence[_Seen], depth: DepthSamples) -> tuple[float, float] | None:
        """ln(metres per odometry unit) from depths on markers, whose distances are known."""
        ratios, relatives = [np.empty(0)], [np.empty(0)]
        for marker in seen:
            if (pose := believed(marker.found)) is not None:
                ratio, relative = self._ratios(pose.T_cam_marker, marker.side_m, depth)
                ratios.append(ratio)
                relatives.append(relative)
        ratio, relative = np.concatenate(ratios), np.concatenate(relatives)
        if len(ratio) < _MIN_SAMPLES:
            return None
        middle = float(np.median(ratio))
        scatter = 1.4826 * float(np.median(np.abs(ratio - middle))) / math.sqrt(len(ratio))
        common = _COMMON_SIGMAS * float(np.median(relative))
        return middle, math.hypot(scatter, _COMMON_LOG_SCALE, common, self._config.side_share)

    def _ratios(self, T_cam_marker: Mat4, side_m: float, depth: DepthSamples) -> tuple[F64, F64]:
        """Log ratio of metric to odometry depth of samples on a marker, and their sigmas."""
        rays = np.column_stack(
            (self._camera.normalise(depth.pixels.astype(np.float64)), np.ones(len(depth.pixels)))
        )
        normal = T_cam_marker[:3, 2]
        facing = rays @ normal
        z = (normal @ T_cam_marker[:3, 3]) / np.where(np.abs(facing) > 1e-9, facing, np.nan)
        local = (z[:, None] * rays - T_cam_marker[:3, 3]) @ T_cam_marker[:3, :3]
        inverse = depth.inverse_depth.astype(np.float64)
        on_marker = np.abs(local[:, :2]).max(axis=1, initial=0.0) <= _REACH * side_m
        good = on_marker & (z > 0.0) & (inverse > _MIN_INVERSE)
        return np.log(z[good] * inverse[good]), depth.sigma[good] / inverse[good]


def with_metres(fix: Fix, scale: tuple[float, float] | None) -> Fix:
    """The fix with the scale that markers tell, where they tell it better."""
    if scale is None or not fix.found:
        return fix
    if fix.log_scale_sigma is not None and fix.log_scale_sigma <= scale[1]:
        return fix
    return replace(fix, log_scale=scale[0], log_scale_sigma=scale[1])


def _distance(T_map_cam: Mat4, marker: _Seen) -> float:
    assert marker.T_map_marker is not None
    return float(np.linalg.norm(marker.T_map_marker[:3, 3] - T_map_cam[:3, 3]))
