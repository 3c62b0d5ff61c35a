# SPDX-License-Identifier: Apache-2.0
"""The nouns that cross stage borders.

Arrays are made read-only by their sender. Poses are (4, 4) float64; T_map_cam
takes camera points to the map. Time is `t_ns`, integer nanoseconds at
mid-exposure. Covariances are (6, 6) float64 of a twist on the left
(`exp(xi) @ T`), translation [m or odometry units] first, then rotation [rad];
those of map poses (Query, Fix, MapPose) are of the camera's position in the map
and of its rotation, both in map axes: `R_true = exp(w) @ R`, `p_true = p + v`.
"""

import enum
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Mat4: TypeAlias = NDArray[np.float64]  # (4, 4) rigid transform
Mat6: TypeAlias = NDArray[np.float64]  # (6, 6)
F32: TypeAlias = NDArray[np.float32]
F64: TypeAlias = NDArray[np.float64]
I32: TypeAlias = NDArray[np.int32]
U8: TypeAlias = NDArray[np.uint8]
Bools: TypeAlias = NDArray[np.bool_]


class Pinhole(NamedTuple):
    """An ideal camera; pixel centres lie on integers. Kernels take it as it is."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


class OdometryState(enum.Enum):
    """Where the odometry is in its life."""

    WAITING = "waiting"  # no reference frame: too dark, too blank, or just begun
    INITIALISING = "initialising"  # has a reference, waits for enough parallax
    TRACKING = "tracking"
    LOST = "lost"  # this frame could not be tracked; the next one starts anew


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One grey image as it came from a camera, distorted as it is."""

    index: int  # place in the recording or the camera's sequence number
    t_ns: int
    image: U8  # (h, w)
    exposure_ns: int | None = None
    gain_db: float | None = None
    # The same image (h, w, 3), red first, where the source has colour; made when it is asked for.
    colour: Callable[[], U8 | None] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class DepthSamples:
    """Sparse inverse depths in one keyframe, in ideal full-size pixels."""

    pixels: F32  # (n, 2) u, v
    inverse_depth: F32  # (n,) [1 / odometry unit]
    sigma: F32  # (n,) its standard deviation


@dataclass(frozen=True, slots=True, eq=False)
class MapStart:
    """What the map tells of a recent frame, for an odometry to start from."""

    index: int  # of the frame
    depth: DepthSamples
    velocity: F64  # (6,) of the camera in its own axes [1/s, rad/s]; 0 where it is not known


class LineSearch(NamedTuple):
    """A look for straight edges in one image."""

    segments: int  # that it shows
    ms: float  # to find them and pair them with known lines; 0 where no clock was given


@dataclass(frozen=True, slots=True, eq=False)
class KeyframePose:
    """A keyframe's pose as the window knows it now."""

    index: int  # of its frame
    T_odom_cam: Mat4
    t_ns: int | None = None  # known of frames that came without a pose


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeResult:
    """What the keyframe work gave, on the frame at which it takes effect."""

    frame: Frame  # the keyframe itself
    T_odom_cam: Mat4
    depth: DepthSamples
    window: tuple[KeyframePose, ...]  # oldest first, the new one included
    covariance: Mat6 | None = None  # of T_newest_previous, this keyframe and the one before
    in_map_units: bool = False  # of a start from the map
    # Frames that came without a pose, which is known now: since a start from the map and until it
    # took effect, and from before any start.
    followed: tuple[KeyframePose, ...] = ()
    line_searches: tuple[LineSearch, ...] = ()  # in keyframes since the last result
    # (3,) how far the camera turned while the rows were read [rad, its own axes]; None: unknown
    rows_turned_rad: F64 | None = None
    readout_s: float = 0.0  # from the first row's exposure to the last one's, as far as is known


@dataclass(frozen=True, slots=True, eq=False)
class OdometryUpdate:
    """What the odometry knows after one frame.

    `T_odom_cam` is None unless `state` is TRACKING. `reference_index` is the
    frame index of the keyframe it was tracked against: a later correction of
    that keyframe's pose moves this frame rigidly with it. When a start
    succeeds, `keyframe` carries the newest keyframe of the first window.
    """

    index: int
    t_ns: int
    state: OdometryState
    odom_id: int  # 1, 2, ...; a restart opens a new odometry frame
    T_odom_cam: Mat4 | None = None
    reference_index: int | None = None
    T_reference_cam: Mat4 | None = None
    covariance: Mat6 | None = None  # of T_reference_cam [odometry units]
    quality: float = 0.0  # 0 (useless) to 1: inlier share times spread of points
    is_keyframe: bool = False  # this frame was chosen; its result follows later
    keyframe: KeyframeResult | None = None  # took effect with this frame
    line_searches: tuple[LineSearch, ...] = ()  # for a start, in this frame


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """A frame for the relocaliser; newest wins."""

    frame: Frame
    odom_id: int | None = None  # None while there is no odometry
    T_odom_cam: Mat4 | None = None
    depth: DepthSamples | None = None
    T_map_cam_prior: Mat4 | None = None  # where registration believes this frame is
    prior_covariance: Mat6 | None = None
    rows_turned_rad: F64 | None = None  # as of KeyframeResult


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """A relocalisation attempt, found or not; registration decides on its acceptance."""

    index: int
    t_ns: int
    odom_id: int | None
    T_odom_cam: Mat4 | None  # of the query's own frame
    found: bool  # the relocaliser itself believes it
    reason: str  # "ok", or why not
    candidates: tuple[int, ...] = ()  # map keyframes asked
    matches: int = 0
    inliers: int = 0
    T_map_cam: Mat4 | None = None
    covariance: Mat6 | None = None  # [m^2, rad^2]
    support: tuple[int, ...] = ()  # map keyframes whose points the inliers are
    log_scale: float | None = None  # ln(map metres per odometry unit), from depths
    log_scale_sigma: float | None = None
    depth_m: float | None = None  # harmonic mean depth of the inliers: the scene's size
    ms: float = 0.0
    lines: int = 0  # of the inliers, those that are lines
    depth: DepthSamples | None = None  # of the inliers in this frame [1 / map unit]
    line_searches: tuple[LineSearch, ...] = ()  # in this frame; none where points were certain
    lens_wrong: bool = False  # several images say so: no fix since then can be right


@dataclass(frozen=True, slots=True, eq=False)
class MapPose:
    """The published pose of one frame."""

    index: int
    t_ns: int
    T_map_cam: Mat4
    T_map_cam_smooth: Mat4
    covariance: Mat6
    scale: float  # metres per odometry unit
    reset_counter: int  # counts jumps of the smooth stream


class Mask(NamedTuple):
    """The pixels of one object, kept only inside its box."""

    left: int  # column of the image [px]
    top: int
    inside: Bools  # (h, w)


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """What a segmentation model saw in one image, best first, in that image's own pixels."""

    boxes: F32  # (n, 4) left, top, right, bottom edge [px]
    scores: F32  # (n,) 0 to 1
    classes: I32  # (n,) places in the model's list of names
    masks: tuple[Mask, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Moving:
    """Where an image shows things that move by themselves."""

    index: int  # of its frame
    t_ns: int
    masks: tuple[Mask, ...]  # in that image's own pixels


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """A frame in which changes are looked for."""

    index: int
    t_ns: int
    image: U8  # (h, w) grey, as it came
    T_map_cam: Mat4
    surface: F64  # (n, 3) points of the scene as it is now, in the map [m]; maybe none
    detections: Detections | None = None  # None where no model ran
    depth: DepthSamples | None = None  # measured in this very image, in the map's unit
    faint: Detections | None = None  # what the model saw less surely


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """One view that speaks for a change."""

    index: int
    t_ns: int
    T_map_cam: Mat4
    mask: Mask | None  # what was seen there, or where it should have been


@dataclass(frozen=True, slots=True, eq=False)
class ChangeEvent:
    """Something that has come or gone, as sure as it had to be."""

    id: int
    t_ns: int
    kind: str  # added or removed
    label: str  # "unknown" where no model tells
    score: float  # 0 to 1
    center_map_m: F64  # (3,)
    extent_m: F64  # (3,)
    n_views: int  # distinct viewpoints that say so
    log_odds: float
    source: str  # model or geometry
    evidence: tuple[Evidence, ...]
    partner: int | None = None  # the other event of a thing that was moved
    image: U8 | None = None  # (h, w) grey, of the view that made it sure
