# SPDX-License-Identifier: Apache-2.0
"""How fixes become map poses. Lengths are shares of the scene's depth: maps may lack metres."""

import msgspec

from edge.config.numbers import Amount, Count, Positive, Probability, Whole


class RegistrationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gates, drift model and smoothing of the map pose."""

    # Two fixes are two votes only if the camera moved this far (share of the scene's depth) ...
    vote_baseline_depth_share: Amount = 0.012
    # ... or if at most this share of their map keyframes is common.
    vote_support_overlap: Amount = 0.34
    # Fixes that must agree before the first pose: two of the last three.
    first_agreeing: Count = 2
    first_of_last: Count = 3
    # Fixes that hold the place before a pose is told: two in a row may err alike, and did so
    # where a third, a tenth of a second later, spoke against them.
    publish_fixes: Count = 3
    # Without odometry, fixes are of one motion only if it is no faster than this.
    fastest_depths_per_s: Amount = 3.0
    fastest_rad_per_s: Amount = 6.0
    # Rejected fixes that must agree with one another before they overrule the anchor.
    overrule_agreeing: Count = 3
    overrule_of_last: Count = 4
    # After so many fixes in a row that do not agree by the odometry, it starts anew.
    contradicted_after: Count = 4
    # ... or after so many of so many last ones, where others between them agree. On 26 good drives
    # at most 2 of 10 did not.
    contradicted_of_last: Count = 10
    # Chi-square quantile (probability) up to which a fix agrees with the prediction.
    gate_probability: Probability = 0.999
    # Share of a fix's covariance that the next fix from the same place repeats: map errors.
    common_share: Amount = 0.6
    # Path (share of depth) and turn after which those common errors are forgotten (1 / e).
    common_path_depth_share: Positive = 1.0
    common_turn_deg: Positive = 60.0
    # How well an odometry that starts from the map's depths has its unit: it was 0.1 to 0.7 % off
    # on rendered drives and a car's, 1 to 4 % on hand-held ones of a rolling shutter.
    seed_log_scale: Positive = 0.04
    # Chi-square quantile (probability) up to which the way between fixes agrees with that unit.
    seed_gate_probability: Probability = 0.9
    # Half of the error of a scale from depths is common, and kept this many times as long.
    common_scale_share: Amount = 0.5
    common_scale_keeps: Positive = 5.0

    # Odometry drift: random walks over the path in scene depths and over the turn in radians.
    # These are of a hand-held rolling shutter; how much less there is, the filter learns.
    drift_position_depth_share: Positive = 0.012
    drift_rotation_rad: Positive = 0.012
    drift_log_scale: Positive = 0.05
    # Frames of a window hold one another: only so much of the drift goes by the path instead of
    # by how far two frames lie apart.
    drift_path_share: Amount = 0.25
    # Fixes that are weighed together; the oldest outside the odometry's window leaves first.
    held_fixes: Count = 15
    # Noise of a single frame's tracking, which does not add up; as much less where the odometry
    # drifts less.
    tracking_depth_share: Amount = 0.002
    tracking_rotation_rad: Amount = 0.002
    # Of what a turn does to the rows of a rolling shutter, the part that tracking takes for motion.
    tracking_rows_share: Amount = 0.25

    # A pose less certain than this is not published.
    publish_sigma_depth_share: Amount = 0.06
    publish_sigma_deg: Amount = 3.0
    # Beyond this the anchor is in doubt: fixes must agree anew before one counts.
    doubt_sigma_depth_share: Amount = 0.2
    # After a loss the last pose guides retrieval for so long, its sigma growing at this speed.
    last_place_s: Amount = 10.0
    last_place_depths_per_s: Amount = 0.5

    # Without odometry: so many fixes over so long a time must lie within the share of depth, of
    # one place or, with one fix more, of an even and slow motion.
    rest_fixes: Whole = 4
    rest_span_s: Amount = 0.25
    rest_depth_share: Amount = 0.005
    slow_depths_per_s: Amount = 0.12
    slow_rad_per_s: Amount = 0.6
    # A pose from fixes alone is published for so many frames after the last one; a hand may
    # have sped up by so much.
    rest_hold_frames: Whole = 8
    rest_depths_per_s2: Amount = 0.3
    rest_rad_per_s2: Amount = 0.6

    # The smooth stream: share of the correction taken per frame, and its bounds per frame.
    smooth_share: Amount = 0.15
    smooth_step_m: Amount = 0.008
    smooth_step_deg: Amount = 0.4
    # Corrections beyond this are a jump, counted by reset_counter.
    smooth_jump_m: Amount = 0.5
    smooth_jump_deg: Amount = 15.0

    # Frames whose odometry poses are kept for late fixes: 10 s at 30 Hz.
    history_frames: Count = 300
    # Keep every tracked frame for the final trajectory; a daemon that runs for ever does not.
    keep_trajectory: bool = True
    # Pose graph: robust kernel of a fix [sigmas], and steps at most.
    graph_cauchy_sigma: Positive = 2.0
    graph_max_steps: Whole = 30
