# SPDX-License-Identifier: Apache-2.0
"""Keyframe work: the window's life from one keyframe to the next."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.image.pyramid import Pyramid, PyramidBuilder, Undistortion
from edge.lines.work import Clock, LineWork, no_clock
from edge.odometry import candidates as cand
from edge.odometry import kernels_window as kw
from edge.odometry import map_start
from edge.odometry.anchors import RESIDUAL_VARIANCE_GREY2
from edge.odometry.leaving import flag_leaving, let_go
from edge.odometry.lens import LensEstimate
from edge.odometry.looking_back import LookingBack
from edge.odometry.map_start import Ahead, MapSeed
from edge.odometry.motion import STANDING, PathPose, start_motions
from edge.odometry.moving import Covered, clear, let_wait
from edge.odometry.reference import Reference, make_reference
from edge.odometry.start_prior import hold
from edge.odometry.starter import Start, brightness_against
from edge.odometry.tracker import Tracker
from edge.odometry.uneven_light import MAX_MOVED_PATHS, LightWatch
from edge.odometry.window import Window
from edge.odometry.window_points import depth_samples, not_newest, points_of, project
from edge.types import F32, F64, U8, DepthSamples, Frame, KeyframePose, KeyframeResult, Mat4

log = logging.getLogger(__name__)

# Keyframes of the first window: reference, newest and some between.
START_KEYFRAMES = 4
START_ITERATIONS = 15
# Share of the start's candidates that must survive the first optimisation.
MIN_START_SURVIVAL = 0.35
MIN_START_POINTS = 60
# With fewer points than this share of those wanted, the map helps out.
LOW_SHARE = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class MappedKeyframe:
    """What the keyframe work hands to the tracking thread and to the outside."""

    epoch: int  # of the life it belongs to: after a loss, older results are void
    reference: Reference
    result: KeyframeResult
    energy: float  # mean of a residual [grey^2]
    points: int
    undistortion: Undistortion  # for further images
    ahead: Ahead | None = None  # of a start from the map
    is_void: bool = False  # images of another kind say otherwise: the odometry is to start anew


@dataclass(frozen=True, slots=True, eq=False)
class SeenFrame:
    """A frame and what its tracking gave."""

    frame: Frame
    T_cam_odom: Mat4
    affine: F64  # (2,) a, b
    sigma_t: float  # uncertainty of its place [odometry units]


class Mapper:
    """Owned by the thread of the keyframe work; `builder` is its own."""

    def __init__(
        self, builder: PyramidBuilder, config: OdometryConfig, clock: Clock = no_clock
    ) -> None:
        """`clock` tells what looking for lines costs."""
        self._builder, self._config = builder, config
        self._line_work = LineWork(clock)
        self._masks, self._pinholes = builder.masks, builder.pinholes
        self._tracker = Tracker(self._pinholes, self._masks, config)
        pinhole = builder.pinholes[0]
        self._max_search_px = config.search_share * (pinhole.width + pinhole.height)
        self._selector = cand.CandidateSelector(self._masks[0], config)
        self._wanted = config.points or 0
        self._lens = LensEstimate()
        self._past = LookingBack(builder, self._tracker, config)
        self.reset()

    def reset(self) -> None:
        """Forget the window."""
        self.window = Window(self._pinholes[0], self._masks[0], self._config)
        self.window.lines.work = self._line_work
        self._distance_px = 2.0
        self._epoch = 0
        self._path: list[PathPose] = []  # of the last two frames
        self._uncentred = False  # the newest keyframe's rates lack the frame after it
        self._covered: Covered | None = None  # by what moves
        self._light = LightWatch()
        self._past.forget()

    # --- start ---

    def start(self, start: Start, epoch: int, past: Sequence[Frame] = ()) -> MappedKeyframe | None:
        """Build the first window; None when it does not hold. `past` is all until then."""
        self.reset()
        self._epoch = epoch
        share = (len(start.frames) - 1) / (START_KEYFRAMES - 1)
        chosen = sorted({round(k * share) for k in range(START_KEYFRAMES)})
        affine = np.zeros(2)
        motions = start_motions(start)
        for i, (frame, T) in enumerate(zip(start.frames, start.T_cam_reference, strict=True)):
            pyramid = self._builder.build(frame.image, motions[i].turning)
            if i == 0:
                self._builder.leave_out_frame(pyramid)
            else:
                first = self.window.images[self.window.keyframes[0].slot]
                affine = brightness_against(first, pyramid.levels[0], self._masks[0])
                cand.trace_all(self.window, pyramid.levels[0], T, affine, self._max_search_px)
            if i in chosen:
                keyframe = self.window.add_keyframe(frame, pyramid, T, affine, motions[i].velocity)
                if i == 0:
                    keyframe.candidates = self._selector.select(
                        pyramid.levels[0], self._wanted, frame.index
                    )
        if start.information is not None:
            hold(self.window.prior, self.window.keyframes, start.information, chosen)
        traced = cand.activate(self.window, 0.0, np.zeros((3, 0), np.float32))
        if traced < MIN_START_POINTS:
            log.debug("start failed traced=%d", traced)
            return None
        energy = self.window.optimise(START_ITERATIONS)
        survived = self.window.points.shape[1]
        limit = kw.PATTERN_SIZE * self._config.outlier_grey**2
        log.debug("start energy=%.1f traced=%d survived=%d", energy, traced, survived)
        if survived < max(MIN_START_POINTS, MIN_START_SURVIVAL * traced) or energy > limit:
            return None
        for index in range(len(self.window.keyframes)):
            self.window.prior.rebase(self.window.keyframes, index)
        self._past.begin(past, self.window)
        return self._finish(pyramid, energy)

    def start_from_map(
        self, seed: MapSeed, epoch: int, past: Sequence[Frame] = ()
    ) -> MappedKeyframe | None:
        """Begin the window with one frame whose depths the map told; None when it does not hold.

        The odometry's unit is the map's then. No parallax is needed; what follows refines it.
        past : all frames until that one, to be tracked afterwards
        """
        self.reset()
        self._epoch = epoch
        window, first = self.window, seed.frames[0]
        pyramid = self._builder.build(first.image)
        self._builder.leave_out_frame(pyramid)
        window.add_keyframe(first, pyramid, np.eye(4), np.zeros(2))
        if map_start.plant(window, seed.told.depth, self._builder.scale) < MIN_START_POINTS:
            return None
        self._past.begin(past, window)
        mapped = self._finish(pyramid, kw.PATTERN_SIZE * RESIDUAL_VARIANCE_GREY2)
        ahead = map_start.follow(
            window, mapped.reference, seed, self._builder, self._tracker, self._config,
            self._lens.most_readout_s,
        )  # fmt: skip
        if ahead is None:
            return None
        poses = [mapped.reference.T_odom_cam, *(pose.T_odom_cam for pose in ahead.poses)]
        path = [PathPose(f.t_ns, se3.inverse(T)) for f, T in zip(seed.frames, poses, strict=True)]
        self._path, self._uncentred = path[-2:], len(path) == 1
        if len(path) > 1:
            window.correct_rates(0, path[0].motion_to(path[1]), self._builder)
        result = replace(mapped.result, in_map_units=True, followed=ahead.poses)
        return replace(mapped, result=result, ahead=ahead)

    # --- every frame ---

    def observe(self, seen: SeenFrame, pyramid: Pyramid) -> None:
        """Search the candidates in a tracked frame."""
        self._centre_rates(seen.frame, seen.T_cam_odom)
        if pyramid.undistortion.even_light == self._builder.used.even_light:
            self._trace(seen, pyramid)
        self._past.step()

    def _trace(self, seen: SeenFrame, pyramid: Pyramid) -> None:
        pose, reach = (seen.T_cam_odom, seen.affine), self._max_search_px
        cand.trace_all(self.window, pyramid.levels[0], *pose, reach, seen.sigma_t)

    def _centre_rates(self, frame: Frame, T_cam_odom: Mat4) -> None:
        """After a keyframe, the next frame tells how the camera moved in its middle."""
        here = PathPose(frame.t_ns, T_cam_odom)
        if self._uncentred and self._path:
            motion = self._path[0].motion_to(here)
            self.window.correct_rates(len(self.window.keyframes) - 1, motion, self._builder)
        self._uncentred = False
        self._path = [*self._path[-1:], here]

    # --- keyframes ---

    def add_keyframe(self, seen: SeenFrame, tracked: Pyramid) -> MappedKeyframe:
        """Take a frame into the window, optimise, let go what is no longer seen.

        `tracked` is its image as the tracking made it.
        """
        window, frame, T_cam_odom = self.window, seen.frame, seen.T_cam_odom
        here = PathPose(frame.t_ns, T_cam_odom)
        motion = self._path[-1].motion_to(here) if self._path else STANDING
        self._path = [*self._path[-1:], here]
        self._uncentred = True
        if self._builder.is_like(tracked, motion.turning):
            pyramid = replace(tracked, undistortion=self._builder.used, turning=motion.turning)
        else:
            pyramid = self._builder.build(frame.image, motion.turning)
        self._trace(seen, pyramid)
        window.add_keyframe(frame, pyramid, T_cam_odom, seen.affine, motion.velocity)
        flag_leaving(window, self._config)
        self._distance_px = cand.spread_distance(
            self._distance_px, window.points.shape[1], self._wanted
        )
        cand.activate(window, self._distance_px, project(window)[:, not_newest(window)])
        energy = window.optimise(self._config.window_iterations)
        return self._finish(pyramid, energy)

    def _finish(self, pyramid: Pyramid, energy: float) -> MappedKeyframe:
        """Hand out the new reference, then clear up the window."""
        window, newest = self.window, self.window.keyframes[-1]
        is_void = self._learn()
        if newest.undistortion is not pyramid.undistortion:
            pyramid = self._builder.build(newest.frame.image, newest.turning)
        projected = project(window)
        use = (window.residual[-1] == kw.INLIER) | ~not_newest(window)
        weight = np.where(use, np.sqrt(window.depth_information), np.float32(0.0))
        reference = make_reference(
            newest.frame.index,
            newest.T_odom_cam,
            newest.affine,
            pyramid,
            self._masks,
            self._pinholes,
            projected,
            weight,
        )
        result = KeyframeResult(
            frame=newest.frame,
            T_odom_cam=newest.T_odom_cam,
            depth=depth_samples(window, projected, use, energy, self._builder.scale),
            window=tuple(KeyframePose(k.frame.index, k.T_odom_cam) for k in window.keyframes),
            covariance=window.covariance,
            followed=self._past.take(),
            line_searches=self._line_work.take(),
            rows_turned_rad=self._lens.readout_s * newest.turning,
            readout_s=self._lens.readout_s,
        )
        mapped = MappedKeyframe(
            self._epoch, reference, result, energy, window.points.shape[1], self._builder.used,
            is_void=is_void,
        )  # fmt: skip
        let_go(window)
        newest.candidates = self._selector.select(
            window.images[newest.slot], self._config.candidates or 0, newest.frame.index
        )
        let_wait(window, self._covered)
        return mapped

    def replenish(self, depth: DepthSamples, T_odom_cam: Mat4) -> None:
        """Take points that the map tells of a recent frame, where the window runs out of its own.

        While the camera turns on the spot, no parallax tells the depths of what comes into view.
        """
        window = self.window
        if not window.keyframes or window.points.shape[1] > LOW_SHARE * self._wanted:
            return
        T_newest_frame = window.keyframes[-1].T_cam_odom @ T_odom_cam
        scale = self._builder.scale
        seen = map_start.seen_from(depth, T_newest_frame, self._pinholes[0], scale)
        map_start.plant(window, seen, scale, project(window))

    def _learn(self) -> bool:
        """Learn lens and light from the window; whether light had drawn it too far along."""
        builder, window, used = self._builder, self.window, self._builder.used
        if window.lens is not None and self._lens.add(window.lens):
            found = self._lens.radial, self._lens.readout_s, self._lens.falloff
            log.info("event=lens radial=%.4f readout_s=%.4f falloff=%.2f", *found)
            builder.use(replace(builder.undistortion(*found), even_light=used.even_light))
        if not used.even_light and self._light.is_uneven(window, project(window)):
            log.info("event=uneven_light")
            builder.use(replace(builder.used, even_light=True))
        if builder.used is used:
            return False
        self._past.remake()
        moved = window.remake(builder, START_ITERATIONS)
        return moved > MAX_MOVED_PATHS and builder.used.even_light != used.even_light

    def hide(self, covered: Covered) -> None:
        """Measure nothing by what moved there."""
        self._covered = covered
        if self.window.keyframes:
            clear(self.window, self.map_points()[0], covered, self._pinholes[0])

    def map_points(self) -> tuple[F32, U8]:
        """Active points: positions in the odometry frame (n, 3) and grey (n,) uint8."""
        return points_of(self.window)
