# SPDX-License-Identifier: Apache-2.0
"""Poses from the lines of a map: beside those from its points, or in their place."""

import math
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from edge.config.lines import PairingConfig, SegmentConfig
from edge.config.relocalise import RelocaliseConfig
from edge.errors import ConfigError
from edge.geometry import se3, so3
from edge.geometry.camera import CameraModel
from edge.geometry.covariance import position_sigma, rotation_sigma
from edge.lines.detector import SegmentDetector
from edge.lines.guided import GuidedPose, localise
from edge.lines.line import Segments, take, take_segments
from edge.lines.work import Clock, LineWork, no_clock
from edge.relocalise.correspondences import pose_difference
from edge.relocalise.gates import UNCERTAIN
from edge.relocalise.seeds import along_lines, joined
from edge.tiles.lines import MapLines
from edge.tiles.reader import Map
from edge.types import F32, F64, U8, DepthSamples, Fix, Mat4, Mat6, Pinhole, Query

_KEYFRAMES = 12  # whose lines are looked for
_MAX_TURN_RAD = math.radians(60.0)  # between their axes and the camera's
_SEEN_TOGETHER = 8  # lines: fewer say nothing about how deep the scene is
_AGREE_CHI2 = 22.5  # 99.9 % of six freedoms
_MEDIAN_CHI2 = 1.386  # of two
# Without points: so many lines, and so large a part of those that should be seen, must agree.
# Parallel neighbours agree with wrong poses, too: in rooms of lines by a share of 0.43 at most,
# where right poses had 0.42 and more. In a cluttered kitchen half of the right ones pass.
_ALONE_AGREE = 12
_ALONE_SHARE = 0.42
# One sigma of the prior in the image, beyond which a neighbour may be nearer than the line itself.
_ALONE_PRIOR_PX = 8.0
# Errors that lines share (poses of the same keyframes, one lens) do not average away: a factor of
# variances. Beside points more: on a hand-held video with 5 they made fixes 14 % worse, with 40
# they make them 20 % better; in rooms of lines fixes become three times as good either way.
_SHARED, _SHARED_BESIDE_POINTS = 5.0, 40.0


class Told(NamedTuple):
    """What the lines tell of a pose."""

    T_map_cam: Mat4
    covariance: Mat6  # of position and rotation, map axes
    agree: int  # pairs
    pairs: int
    share: float  # of the lines that should be seen, those that agree
    depth_m: float  # harmonic mean depth of the lines that agree
    keyframes: tuple[int, ...]  # that saw them
    depth: DepthSamples  # along those that agree


class LineFixes:
    """Adds to fixes what the map's lines tell, where that is worth its time.

    Owned by the relocaliser's thread. A fix from points that is certain is left as it is: no
    segment is looked for then.
    """

    def __init__(
        self, map_: Map, camera: CameraModel, config: RelocaliseConfig, clock: Clock = no_clock
    ) -> None:
        """`clock` tells what searches cost."""
        self._map, self._config = map_, config
        if config.landmarks == "lines" and map_.lines.count == 0:
            raise ConfigError(
                f'relocalise.landmarks: "lines", but {map_.folder} has none; build it with --lines'
            )
        self._lone = config.landmarks == "lines"
        self._used = config.landmarks != "points" and map_.lines.count > 0
        self._camera = camera.pinhole
        self._detector = SegmentDetector(SegmentConfig())
        self._work = LineWork(clock)
        self._tables: tuple[F32, F32, U8] | None = None
        if self._used and camera.distortion_model != "none":
            self._tables = camera.undistortion_maps()

    def guides(self, query: Query) -> bool:
        """Whether points need not be asked: only lines count, and it is known about where."""
        return self._lone and query.T_map_cam_prior is not None

    def alone(self, query: Query) -> Fix:
        """Fix from lines only, near the query's prior."""
        frame = query.frame
        nothing = Fix(
            frame.index, frame.t_ns, query.odom_id, query.T_odom_cam, False, "few lines agree"
        )
        return self.added(query, nothing)

    def added(self, query: Query, fix: Fix) -> Fix:
        """The fix with what lines tell beside it."""
        if not self._used or (self._lone and query.T_map_cam_prior is None):
            return fix
        start = self._start(query, fix)
        if start is None:
            return fix
        told = self._told(query.frame.image, start[0])
        fix = replace(fix, line_searches=self._work.take())
        if told is None:
            return fix
        if fix.T_map_cam is not None and fix.covariance is not None:
            return self._joined(fix, told)
        return self._by_lines(fix, told, start)

    def _start(self, query: Query, fix: Fix) -> tuple[Mat4, Mat6] | None:
        """Pose to look for lines from, if they are worth looking for."""
        believed = fix.found or fix.reason in UNCERTAIN
        if believed and fix.T_map_cam is not None and fix.covariance is not None:
            return None if self._is_certain(fix) else (fix.T_map_cam, fix.covariance)
        if fix.T_map_cam is not None:  # points speak against it: lines are no better judge
            return None
        if query.T_map_cam_prior is None or query.prior_covariance is None:
            return None
        return query.T_map_cam_prior, query.prior_covariance

    def _is_certain(self, fix: Fix) -> bool:
        assert fix.covariance is not None
        share = position_sigma(fix.covariance) / (fix.depth_m or math.inf)
        turn = math.degrees(rotation_sigma(fix.covariance))
        enough = share < self._config.lines_above_depth_share
        return fix.found and enough and turn < self._config.lines_above_deg

    def _told(self, image: U8, T_map_cam: Mat4) -> Told | None:
        began_ns = self._work.clock()
        near = self._near(T_map_cam)
        if near is None:
            return None
        known, keyframes = near
        segments = self._segments(image)
        guided = localise(
            known.lines,
            known.span,
            segments,
            self._camera,
            se3.inverse(T_map_cam),
            PairingConfig(),
        )
        self._work.add(len(segments.length), began_ns)
        if guided is None:
            return None
        depth = _depths(guided, known, segments, self._camera)
        return _told(guided, known, keyframes, depth)

    def _near(self, T_map_cam: Mat4) -> tuple[MapLines, tuple[int, ...]] | None:
        """The lines that keyframes see from near by, looking the same way."""
        poses = self._map.T_map_cam
        turn = np.arccos(np.clip(poses[:, :3, 2] @ T_map_cam[:3, 2], -1.0, 1.0))
        away = np.linalg.norm(poses[:, :3, 3] - T_map_cam[:3, 3], axis=1)
        order = np.lexsort((np.arange(len(away)), away, turn > _MAX_TURN_RAD))[:_KEYFRAMES]
        chosen = tuple(int(k) for k in order if turn[k] <= _MAX_TURN_RAD)
        seen = [self._map.lines.seen_by(k) for k in chosen]
        indices = np.unique(np.concatenate([np.empty(0, np.int32), *seen]))
        if len(indices) < _SEEN_TOGETHER:
            return None
        return self._map.lines.take(indices.astype(np.int32)), chosen

    def _segments(self, image: U8) -> Segments:
        if self._tables is None:
            return self._detector.detect(image)
        map_x, map_y, valid = self._tables
        ideal = np.asarray(cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR), np.uint8)
        return self._detector.detect(ideal, valid)

    def _joined(self, fix: Fix, told: Told) -> Fix:
        """Both poses, weighed by their certainty; the points' alone where they disagree."""
        assert fix.T_map_cam is not None
        assert fix.covariance is not None
        off = pose_difference(told.T_map_cam, fix.T_map_cam)
        both = fix.covariance + _SHARED_BESIDE_POINTS / _SHARED * told.covariance
        if off @ np.linalg.solve(both, off) > _AGREE_CHI2:
            return fix
        gain = np.linalg.solve(both, fix.covariance).T
        T = _moved(fix.T_map_cam, gain @ off)
        covariance = fix.covariance - gain @ fix.covariance
        covariance = 0.5 * (covariance + covariance.T)
        found = fix.found or self._sure_enough(covariance, fix.depth_m or told.depth_m)
        return _fixed(fix, T, covariance, told, found=found)

    def _by_lines(self, fix: Fix, told: Told, start: tuple[Mat4, Mat6]) -> Fix:
        """The pose of the lines alone, if it is certain and lies where it may."""
        if told.agree < _ALONE_AGREE or told.share < _ALONE_SHARE:
            return replace(fix, reason="few lines agree")
        turn = rotation_sigma(start[1])
        prior_px = self._camera.fx * math.hypot(position_sigma(start[1]) / told.depth_m, turn)
        if prior_px > _ALONE_PRIOR_PX:
            return replace(fix, reason="known too roughly for lines")
        off = pose_difference(told.T_map_cam, start[0])
        if off @ np.linalg.solve(start[1] + told.covariance, off) > _AGREE_CHI2:
            return replace(fix, reason="lines tell another place")
        if not self._sure_enough(told.covariance, told.depth_m):
            return replace(fix, reason="lines leave the pose open")
        fix = replace(fix, depth_m=told.depth_m, candidates=told.keyframes)
        return _fixed(fix, told.T_map_cam, told.covariance, told, found=True)

    def _sure_enough(self, covariance: Mat6, depth_m: float) -> bool:
        """Whether a pose that was foretold is certain enough to be believed."""
        slack = self._config.foretold_slack
        near = position_sigma(covariance) < slack * self._config.max_sigma_depth_share * depth_m
        turn_deg = math.degrees(rotation_sigma(covariance))
        return near and turn_deg < slack * self._config.max_sigma_deg


def _moved(T_map_cam: Mat4, step: F64) -> Mat4:
    """The pose after a step of position and rotation (6,), in map axes."""
    R = so3.exp(step[3:]) @ T_map_cam[:3, :3]
    return se3.from_rotation_translation(R, T_map_cam[:3, 3] + step[:3])


def _depths(
    guided: GuidedPose, known: MapLines, segments: Segments, camera: Pinhole
) -> DepthSamples:
    """Depths along the segments that agree."""
    line = guided.pairs.line[guided.agree]
    seen = take_segments(segments, guided.pairs.segment[guided.agree])
    T_map_cam = se3.inverse(guided.pose.T_cam_lines)
    return along_lines(take(known.lines, line), known.span[line], seen, T_map_cam, camera)


def _told(
    guided: GuidedPose, known: MapLines, keyframes: tuple[int, ...], depth: DepthSamples
) -> Told:
    """The guided pose in map axes, as uncertain as the pairs scatter."""
    T = se3.inverse(guided.pose.T_cam_lines)
    # A twist moves the lines before the camera; the camera goes the other way.
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = -T[:3, :3]
    good = guided.agree
    unit = max(1.0, float(np.median(guided.pose.m2[good])) / _MEDIAN_CHI2)
    covariance = _SHARED * unit * (turn @ guided.pose.covariance @ turn.T)
    points = known.lines.point[guided.pairs.line[good]]
    ahead = np.maximum((points - T[:3, 3]) @ T[:3, 2], 1e-6)
    depth_m = 1.0 / float(np.mean(1.0 / ahead))
    agree = int(np.count_nonzero(good))
    share = agree / max(len(guided.pairs.expected), 1)
    return Told(T, covariance, agree, len(good), share, depth_m, keyframes, depth)


def _fixed(fix: Fix, T_map_cam: Mat4, covariance: Mat6, told: Told, *, found: bool) -> Fix:
    for array in (T_map_cam, covariance):
        array.flags.writeable = False
    return replace(
        fix,
        found=found,
        reason="ok" if found else fix.reason,
        T_map_cam=T_map_cam,
        covariance=covariance,
        matches=fix.matches + told.pairs,
        inliers=fix.inliers + told.agree,
        lines=told.agree,
        support=fix.support or told.keyframes,
        depth=joined(fix.depth, told.depth),
    )
