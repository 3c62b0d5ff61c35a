# SPDX-License-Identifier: Apache-2.0
"""The odometry's life: wait, start, track, lose, start again.

`Odometry` is the tracking thread's part: it never waits for keyframe work,
which a `KeyframeWorker` runs in its own time.
"""

from collections import deque
from collections.abc import Callable
from itertools import dropwhile

import numpy as np

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.image.pyramid import Pyramid, PyramidBuilder
from edge.lines.work import Clock, no_clock
from edge.odometry.keyframe_work import DelayedWorker, KeyframeWorker
from edge.odometry.last_motion import LastMotion
from edge.odometry.map_start import MapSeed
from edge.odometry.mapper import MIN_START_POINTS, MappedKeyframe, Mapper, SeenFrame
from edge.odometry.moving import RecentPoses
from edge.odometry.reference import Reference
from edge.odometry.rolling import tracked_straight
from edge.odometry.sizes import halvings_to, levels_of
from edge.odometry.starters import Starters
from edge.odometry.tracker import (
    Tracker,
    covariance_of,
    frozen,
    is_believable,
    quality_of,
    sigma_t_of,
    wants_keyframe,
)
from edge.types import (
    F32,
    U8,
    DepthSamples,
    Frame,
    MapStart,
    Moving,
    OdometryState,
    OdometryUpdate,
)

# Pyramids that may be in flight between tracking and keyframe work, with the last keyframe's.
N_BUFFERS = 7
# A frame with less contrast than this shows nothing: lens covered, light off.
MIN_CONTRAST_GREY = 4.0
# Frames of which one may be started from: a fix takes so long at most.
KEPT_FRAMES = 15
# Memory for frames that are tracked once a start has succeeded: 65 of 640x480.
KEPT_BYTES = 20_000_000


class Odometry:
    """Grey images in, poses in an odometry frame of its own out. Owned by the tracking thread."""

    def __init__(
        self,
        camera: CameraModel,
        config: OdometryConfig | None = None,
        worker: KeyframeWorker | None = None,
        clock: Clock = no_clock,
    ) -> None:
        self._config = (config or OdometryConfig()).resolved()
        pinhole = camera.pinhole
        halvings = halvings_to(pinhole.width * pinhole.height, self._config.max_pixels or 1)
        levels = levels_of(pinhole.width * pinhole.height // 4**halvings)
        self._builder = PyramidBuilder(camera, halvings, levels, N_BUFFERS)
        self._tracker = Tracker(self._builder.pinholes, self._builder.masks, self._config)
        pinhole, mask = self._builder.pinholes[0], self._builder.masks[0]
        self._starter = Starters(pinhole, mask, self._config, clock)
        self._mapper = Mapper(PyramidBuilder(camera, halvings, levels, 1), self._config, clock)
        self._worker = worker or DelayedWorker(self._config.keyframe_delay_frames)
        self._size = pinhole.width + pinhole.height
        self._now, self._odom_id = 0, 1
        self._reference: Reference | None = None
        self._motion: LastMotion | None = None
        self._pending = self._opened = self._from_map = False  # the last: the start under way
        self._epoch = self._started = 0  # starts that were tried; step of the last one
        self._poses = RecentPoses(camera)
        self._recent: deque[Frame] = deque(
            maxlen=max(KEPT_FRAMES, KEPT_BYTES // (camera.width * camera.height))
        )  # while not tracking
        self._told: MapStart | None = None

    def step(self, frame: Frame) -> OdometryUpdate:
        """Take the next frame; what is known after it."""
        self._now += 1
        pyramid = self._builder.build(frame.image)
        arrived = self._install(frame)
        if pyramid.undistortion is not self._builder.used:  # since this frame
            pyramid = self._builder.build(frame.image, instead=True)
        if self._reference is None:
            return self._start(frame, pyramid)
        return self._track(frame, pyramid, arrived)

    def points(self) -> tuple[F32, U8]:
        """Active points now: positions in the odometry frame (n, 3), grey (n,)."""
        return self._mapper.map_points()

    def begin_at(self, told: MapStart) -> None:
        """Start from what the map tells of a recent frame, if need be."""
        if self._reference is not None or not self._config.start_from_map:
            return
        # What cannot start it must not stop the odometry's own start.
        known = any(frame.index == told.index for frame in list(self._recent)[-KEPT_FRAMES:])
        if known and len(told.depth.pixels) >= MIN_START_POINTS:
            self._told = told

    def forget_map(self) -> None:
        """Start no more from what the map has told: it is another map now."""
        self._told = None
        if self._reference is None and self._pending and self._from_map:
            self._epoch += 1  # what comes of the start under way is void

    def replenish(self, index: int, depth: DepthSamples) -> None:
        """Depths that the map tells of a tracked frame, in units of this odometry."""
        T_odom_cam = self._poses.of(index)
        if self._reference is not None and T_odom_cam is not None:
            self._worker.submit(
                lambda: self._mapper.replenish(depth, T_odom_cam), answers=False, may_drop=True
            )

    def restart(self) -> None:
        """Start anew with the next frame, in a new odometry frame."""
        self._reference, self._motion = None, None
        self._forget_recent()
        self._epoch += 1
        self._poses.clear()
        self._starter.reset()

    def hide(self, moving: Moving) -> None:
        """Measure no more by what moved in a recent frame."""
        cover = self._poses.cover(moving)
        if cover is not None:
            self._worker.submit(lambda: self._mapper.hide(cover()), answers=False)

    # --- start ---

    def _start(self, frame: Frame, pyramid: Pyramid) -> OdometryUpdate:
        self._recent.append(frame)
        if self._pending:
            return self._update(frame, OdometryState.INITIALISING)
        if pyramid.contrast_grey < MIN_CONTRAST_GREY:
            self._starter.reset()
            self._forget_recent()
            return self._update(frame, OdometryState.WAITING)
        if not self._starter.has_reference:
            self._builder.leave_out_frame(pyramid)
        grey = np.clip(pyramid.levels[0][..., 0] + 0.5, 0, 255).astype(np.uint8)
        start = self._starter.step(frame, grey)
        past = tuple(self._recent)
        if (seed := self._seed()) is not None:
            past = past[: len(past) + 1 - len(seed.frames)]
            self._submit_start(lambda epoch: self._mapper.start_from_map(seed, epoch, past))
            self._from_map = True
        elif start is not None:
            self._submit_start(lambda epoch: self._mapper.start(start, epoch, past))
            self._from_map = False
        held = self._starter.has_reference
        return self._update(frame, OdometryState.INITIALISING if held else OdometryState.WAITING)

    def _seed(self) -> MapSeed | None:
        """What the map told, with the frames since then."""
        if self._told is None:
            return None
        told, self._told = self._told, None
        since = tuple(dropwhile(lambda frame: frame.index != told.index, self._recent))
        return MapSeed(since, told) if since else None

    def _forget_recent(self) -> None:
        self._recent.clear()
        self._told = None

    def _submit_start(self, work: Callable[[int], MappedKeyframe | None]) -> None:
        self._pending = True
        self._motion = None
        self._started = self._now
        epoch = self._epoch = self._epoch + 1
        self._worker.submit(lambda: work(epoch), answers=True)

    # --- results of keyframe work ---

    def _install(self, frame: Frame) -> MappedKeyframe | None:
        """Take over finished keyframe work; the last one that came."""
        newest = None
        for mapped in self._worker.poll(self._now):
            self._pending = False
            if mapped is None:
                if not self._from_map:
                    self._starter.reset()
                continue
            if mapped.epoch != self._epoch or self._has_better(mapped):
                continue
            if mapped.is_void:
                self._builder.use(mapped.undistortion)
                self.restart()
                continue
            newest = mapped
            self._adopt(mapped, frame)
        return newest

    def _has_better(self, mapped: MappedKeyframe) -> bool:
        """Whether the map has told depths just when the odometry's own start came."""
        return self._reference is None and mapped.ahead is None and self._told is not None

    def _adopt(self, mapped: MappedKeyframe, frame: Frame) -> None:
        if self._reference is None:
            if self._opened:
                self._odom_id += 1
            self._opened = True
            self._forget_recent()
            self._motion = LastMotion.after_start(mapped, frame, max(self._now - self._started, 1))
        self._reference = mapped.reference
        if mapped.undistortion is not self._builder.used:
            self._builder.use(mapped.undistortion)

    # --- tracking ---

    def _track(
        self, frame: Frame, pyramid: Pyramid, arrived: MappedKeyframe | None
    ) -> OdometryUpdate:
        assert self._reference is not None
        assert self._motion is not None
        reference, motion = self._reference, self._motion
        if pyramid.contrast_grey < MIN_CONTRAST_GREY:
            return self._fail(frame, motion, arrived)
        motion.catch_up(frame.t_ns)
        tracked = self._tracker.track(
            pyramid,
            reference,
            motion.guesses(pyramid, self._builder.pinholes[-1], reference),
            motion.affine,
            motion.residual_grey,
        )
        if not is_believable(tracked, reference, self._config) or motion.leaps(tracked, reference):
            return self._fail(frame, motion, arrived)
        tracked, pyramid = tracked_straight(
            frame, (tracked, pyramid), motion, reference, self._tracker, self._builder
        )
        T_odom_cam = se3.normalise(reference.T_odom_cam @ se3.inverse(tracked.T_cam_reference))
        self._poses.add(frame.index, T_odom_cam)
        motion.remember(T_odom_cam, tracked, pyramid, frame.t_ns)
        chosen = not self._pending and wants_keyframe(tracked, reference, self._size, self._config)
        covariance = covariance_of(tracked, self._config.covariance_factor)
        seen = SeenFrame(frame, se3.inverse(T_odom_cam), tracked.affine, sigma_t_of(covariance))
        self._hand_over(seen, pyramid, chosen=chosen)
        return OdometryUpdate(
            index=frame.index,
            t_ns=frame.t_ns,
            state=OdometryState.TRACKING,
            odom_id=self._odom_id,
            T_odom_cam=frozen(T_odom_cam),
            reference_index=reference.index,
            T_reference_cam=frozen(se3.inverse(tracked.T_cam_reference)),
            covariance=frozen(covariance),
            quality=quality_of(tracked),
            is_keyframe=chosen,
            keyframe=arrived.result if arrived else None,
        )

    def _fail(
        self, frame: Frame, motion: LastMotion, arrived: MappedKeyframe | None
    ) -> OdometryUpdate:
        motion.failures += 1
        motion.gap += 1
        motion.T_cam_last = se3.exp(0.5 * se3.log(motion.T_cam_last))
        if motion.failures > self._config.max_failures:
            self.restart()
        return OdometryUpdate(
            index=frame.index,
            t_ns=frame.t_ns,
            state=OdometryState.LOST,
            odom_id=self._odom_id,
            keyframe=arrived.result if arrived else None,
        )

    def _hand_over(self, seen: SeenFrame, pyramid: Pyramid, *, chosen: bool) -> None:
        mapper = self._mapper
        if chosen:
            self._pending = True
            self._builder.keep()  # no other keyframe is chosen before this one is done
            self._worker.submit(lambda: mapper.add_keyframe(seen, pyramid), answers=True)
        else:
            self._worker.submit(lambda: mapper.observe(seen, pyramid), answers=False, may_drop=True)

    def _update(self, frame: Frame, state: OdometryState) -> OdometryUpdate:
        searches = self._starter.take_line_searches()
        return OdometryUpdate(frame.index, frame.t_ns, state, self._odom_id, line_searches=searches)
