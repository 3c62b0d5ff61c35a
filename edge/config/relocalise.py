# SPDX-License-Identifier: Apache-2.0
"""How an image is found in the map, and when the answer is believed."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from edge.config.numbers import Amount, Count, Positive, Whole


class RelocaliseConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Retrieval, matching, pose and gates."""

    # What of the map is looked for. "both": lines of maps that have some (mapvo-map build --lines),
    # where points leave a doubt; "lines": lines alone, but to find a place that is quite unknown.
    landmarks: Literal["points", "lines", "both"] = "both"
    # By what points are known: "orb", or the model (ONNX) that the map was built with, too
    # (mapvo-map build --features MODEL.onnx).
    features: Annotated[str, msgspec.Meta(min_length=1)] = "orb"
    # Lines are looked for where points leave more than this: position as a share of the scene's
    # depth, and rotation. Below it they gain a millimetre and cost as much time as the points.
    lines_above_depth_share: Amount = 0.004
    lines_above_deg: Amount = 0.25
    # Keyframes taken from the inverted index, and with those that share their points.
    retrieved: Count = 6
    pooled: Count = 10
    covisible: Whole = 3
    # And so many near the last known place.
    near_last_place: Whole = 3
    # Of 256; unrelated descriptors lie around 128, one in 1e5 of ORB's below 64. For codes of a
    # learned model it is a cosine of 0.63; with 80 a tenth more was found, and first wrong ones.
    max_bits: Whole = 72
    # The nearest point must beat the nearest that lies elsewhere by this factor.
    max_ratio: Amount = 0.88
    # Points that match one feature are one if they lie within these sigmas of one another,
    agree_sigmas: Amount = 3.0
    # ... to which so many pixels of the camera that saw them are added.
    agree_px: Amount = 1.5
    # Matches must turn as one: kept are bins that hold this share of the fullest one.
    turn_bins: Annotated[int, Meta(ge=1, le=360)] = 30
    turn_min_share: Amount = 0.3

    # Sigma of a feature at octave 0; it grows with the octave's scale.
    sigma_px: Amount = 0.8
    # 99 % of right matches lie below this (chi-square of two degrees of freedom).
    gate_chi2: Amount = 9.21
    # Rounds of the robust search, at most.
    max_rounds: Whole = 600

    # Where the prediction is good, the map is projected by it; false: each image is looked for
    # in the whole map, as in the method of 2021.
    guided: bool = True
    # Guided matching: keyframes whose points are projected, and the window in sigmas of the prior.
    guided_keyframes: Count = 10
    guided_sigmas: Amount = 3.0
    guided_min_px: Amount = 6.0
    # A prior less certain than this does not guide; retrieval is cheaper and safer.
    guided_max_px: Amount = 48.0
    # A point is looked for only within this angle of a view that the map has of it ...
    guided_max_view_deg: Amount = 45.0
    # ... and within so many octaves of where it should appear.
    guided_octaves: Amount = 1.6
    guided_max_bits: Whole = 72
    guided_max_ratio: Amount = 0.9
    # Windows of the last matching around the found pose: points known less well than the
    # greatest of them allows are left out, but the others hold the pose where few are left.
    final_px: Amount = 5.0
    final_max_px: Amount = 24.0

    # Fewer than so many matches are not tried, fewer inliers not believed: a floor, not the gate.
    min_matches: Whole = 12
    min_inliers: Whole = 15
    # Errors that all features of one cell share (calibration, rolling shutter, the map's poses).
    common_px: Amount = 0.4
    common_prior_cells: Amount = 5.0
    # Points in areas of so many cells squared were seen by the same keyframes: errors of those
    # poses move them together along their rays, by this share of their own sigma.
    common_area_cells: Count = 2
    common_depth_sigmas: Amount = 0.5
    # How well calibrations are known: focal length, and where the image's corner lies, as a share
    # of half its diagonal.
    lens_focal_share: Amount = 0.002
    lens_corner_share: Amount = 0.009
    # ... of which so much is left where the map's own tracks have checked the query's camera.
    lens_checked_share: Amount = 0.25
    # A lens that surely differs from its calibration by more makes poses wrong by as much of the
    # depth: in its focal length, and in where the image's corner lies (as above). Of 14 right ones
    # the worst seemed off by 0.7 and 0.3 %, where the camera hung upside down or on its side by
    # 2.5 % at the corners; a 5 % wrong focal length shows in one to three images.
    max_focal_error: Positive = 0.01
    max_corner_error: Positive = 0.015
    # Whether rows were read one after another in a turn is looked at where matches tell so by this
    # (chi-square of three degrees of freedom; images read at once had up to 2.7), and believed
    # where that gains so much log likelihood an inlier (those had up to 0.02).
    rows_chi2: Amount = 2.0
    rows_gain: Amount = 0.06
    # Images from different places that are asked together, the last ones.
    lens_images: Count = 16
    # Reduced chi-square below which inliers do not count as more exact than foreseen.
    least_chi2: Amount = 0.4
    common_cell_px: Count = 80
    # What no number of matches takes away: errors of the map as a share of its depth, and in rad;
    # or as if the whole image were off by so many of the shifts that its cells show, if less.
    floor_share: Amount = 0.0005
    floor_commons: Amount = 0.8
    # Gates on the covariance: position as a share of the scene's depth, and rotation.
    max_sigma_depth_share: Amount = 0.015
    max_sigma_deg: Amount = 1.5
    # A pose that its prior foretold may be so many times less certain.
    foretold_slack: Amount = 2.5
    # Inliers must lie in so many cells, and their narrow axis span so much of the image's height.
    min_cells: Whole = 6
    min_spread: Amount = 0.07
    # Share of the foreseen points that fit (of those whose octaves the image has features at),
    # times that of the cells with so many of them in which
    # more fit than by chance, times that of the matches that fit. Right poses had 0.087 and more
    # (50th of them 0.2), mirrored images of symmetric things up to 0.066; a room with the floor and
    # ceiling of another, seen from its other end, up to 0.076.
    expected_in_cell: Whole = 8
    min_evidence: Amount = 0.085
    # A second pose is looked at if it explains so much of what the best one does, and makes the
    # place ambiguous if in the end it explains so much.
    tried_rival_share: Amount = 0.12
    max_rival_share: Amount = 0.6

    # Scale: odometry depths within this distance of a projected point are compared with it.
    scale_px: Amount = 3.0
    # Depths less certain than this (relative) say nothing about the scale.
    scale_max_depth_sigma: Amount = 0.1
    scale_min_points: Whole = 12
    # The plain mean of the ratios, as in the method of 2021: to compare with, not to use.
    scale_mean_ratio: bool = False
    # Spread of single ratios that no sigma tells: the two depths are not quite of one point.
    scale_point_sigma: Amount = 0.01
    # Error that all depths of a window share: always this, and so many of their own sigmas. It
    # was 5 to 8 % between depths and path on a hand-held rolling shutter, 0.2 % on a rendered one.
    scale_common: Amount = 0.04
    scale_common_sigmas: Amount = 3.0
