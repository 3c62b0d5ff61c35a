# SPDX-License-Identifier: Apache-2.0
"""Direct sparse odometry: two presets, and every parameter behind them."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from edge.config.numbers import Count, Positive, Share

# What `preset` sets where the file does not: pixels of level 0, active points, candidates of a
# keyframe, keyframes of the window.
PRESETS = {
    "lean": (160_000, 800, 600, 7),
    "fine": (500_000, 2000, 1500, 6),
}


class OdometryConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pixels below are those of level 0: the image after `max_pixels` halved it."""

    # lean: a Pi-class core at 30 Hz; fine: full-size images and 2000 points. The next four
    # keys, where given, override what the preset says.
    preset: Literal["lean", "fine"] = "lean"
    # The image is halved until it has no more pixels than this; 320x240 keeps up on a Pi.
    max_pixels: Annotated[int, Meta(ge=10_000)] | None = None
    # Active points of the window; accuracy saturates near 2000 (Engel et al. 2018, fig. 14).
    points: Annotated[int, Meta(ge=100, le=5_000)] | None = None
    # Candidates chosen in each keyframe; about 0.75 of `points` keeps the window filled.
    candidates: Annotated[int, Meta(ge=100, le=5_000)] | None = None
    # Keyframes of the window; each adds 8 unknowns and a pass over all points.
    window_keyframes: Annotated[int, Meta(ge=4, le=7)] | None = None

    # Replay: the result of keyframe work takes effect so many frames later, as it does live.
    keyframe_delay_frames: Annotated[int, Meta(ge=0, le=30)] = 1

    # Residuals beyond this many grey levels count linearly; Engel et al. 2018, sec. 2.2.
    huber_grey: Positive = 9.0
    # A gradient of this many grey levels halves a pixel's squared weight; the same, eq. 7.
    gradient_scale_grey: Positive = 50.0
    # Mean residual of a pattern pixel beyond which a candidate is an outlier.
    outlier_grey: Positive = 12.0
    # Part of a marginalised point's information that is kept. Its errors (linearisation, rolling
    # shutter of a translation) are common to many points: at 1 the scale drifts on real video,
    # below 0.1 on rendered ones.
    marginal_weight: Share = 0.15
    # Neighbouring pixels err together: true variances exceed those of independent residuals by
    # this; with it, the normalised errors of rendered drives with exact truth are near one.
    covariance_factor: Positive = 4.0
    # Gauss-Newton steps of the window; it stops earlier where steps are small.
    window_iterations: Count = 6

    # Pixels whose gradient exceeds the region's median by this much may be candidates.
    gradient_margin_grey: Positive = 7.0
    # Search along an epipolar line, as a share of width + height; wider only finds look-alikes.
    search_share: Share = 0.027
    # Best match over the second best elsewhere on the line; below, it is a repeated texture.
    min_uniqueness: Positive = 3.0

    # Straight edges as landmarks of the window, in images that show little else; with texture none
    # are looked for. Of 19 drives through simulated plain rooms 12 became better, most by a quarter
    # to a half, and two worse by more than a fifth.
    window_lines: bool = True

    # Find the radial bend of the lens that the calibration missed, and its dark corners; both
    # bend the path (1 px in a corner: some 20 % more error; half the brightness there: twice).
    refine_lens: bool = True

    # Coarse tracking: residuals beyond this many grey levels are left out.
    track_cutoff_grey: Positive = 20.0
    # A tracked frame whose residual grew by this factor is tried from other starts as well.
    retry_factor: Positive = 1.5
    # Below this share of points that agree, the pose is not believed.
    min_inlier_share: Share = 0.45
    # Below this share of the keyframe's points in view, there is too little to stand on.
    min_visible_share: Share = 0.10
    # Fewer agreeing pixels (some five of each point) than this tell rotation at best: a turn on
    # the spot has left all known points behind, and with them the scale.
    min_pixels: Count = 240
    # Frames in a row that may fail before the odometry is lost; a blink is no loss.
    max_failures: Annotated[int, Meta(ge=0, le=100)] = 5

    # A new keyframe when these three, each as a share of width + height, add up to one:
    # image motion by translation, the whole image motion, and the change of brightness (log).
    keyframe_translation: Positive = 0.03
    keyframe_motion: Positive = 0.06
    keyframe_brightness: Positive = 0.5

    # Start: the median relative sigma of the first depths must fall below this. At 0.06 the
    # baseline is some 2-3 % of the depth; starts below 1.2 % bend the whole path.
    start_max_depth_sigma: Positive = 0.06
    # Start: corners tracked from the reference frame, and how many must survive.
    start_corners: Count = 300
    start_min_tracks: Count = 60
    # Start: where so few corners are seen, straight edges help them (plain walls, few things).
    start_lines: bool = True
    # Start from depths that the map tells, as soon as a frame is found in it.
    start_from_map: bool = True
    # Start: the reference is renewed when it is older than this.
    start_max_age_frames: Count = 150

    def resolved(self) -> "OdometryConfig":
        """The same with the preset's values filled in."""
        pixels, points, candidates, keyframes = PRESETS[self.preset]
        return OdometryConfig(
            **{
                **{name: getattr(self, name) for name in self.__struct_fields__},
                "max_pixels": self.max_pixels or pixels,
                "points": self.points or points,
                "candidates": self.candidates or candidates,
                "window_keyframes": self.window_keyframes or keyframes,
            }
        )
