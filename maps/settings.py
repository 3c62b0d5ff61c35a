# SPDX-License-Identifier: Apache-2.0
"""How a map is compiled; the manifest carries these settings."""

from typing import Annotated, Literal

import msgspec

_Positive = Annotated[float, msgspec.Meta(gt=0.0)]
_Count = Annotated[int, msgspec.Meta(ge=0)]


class BuildSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of one build; lengths are in the unit of the given poses."""

    depth: Literal["none", "given", "stereo", "multiview", "lidar"] = "given"
    # Whether cameras may be refined by the tracks of their images, where those ask for it.
    lens: Literal["given", "refined"] = "refined"
    # Whether images may tell that their rows were read one after another.
    shutter: Literal["global", "found"] = "found"
    # Whether lines in space are found, too.
    lines: bool = False
    # Name of a model whose features are found beside ORB's; empty: none are.
    features: str = ""
    # Family of the square markers whose places are stored; empty: none are.
    markers: str = ""
    # Side of the cells that the space is cut into: some tens of keyframes each along a drive.
    tile_m: _Positive = 40.0
    # Views matched with each view: the most alike by their words, and the next in order.
    similar_views: _Count = 14
    following_views: _Count = 2
    # Views that look more apart than this share no corner that ORB would know.
    max_view_angle_deg: _Positive = 60.0
    # Half width of the epipolar band at octave 0: pose errors of half a centimetre at 2 m.
    epipolar_px: _Positive = 3.0
    # Of 256; unrelated descriptors lie around 128, one in 1e5 of them below this.
    max_bits: _Count = 64
    max_ratio: _Positive = 0.85
    # Between the turn of a patch and the turn that the poses foresee.
    max_turn_deg: _Positive = 30.0
    # Standard deviation of a corner at octave 0 before the map's own residuals are known.
    sigma_px: _Positive = 1.0
    # 99 % of correct observations lie below this (chi-square, two degrees of freedom).
    gate_chi2: _Positive = 9.21
    # Errors of the given poses that all views of a point share, as a part of its distance.
    pose_error: Annotated[float, msgspec.Meta(ge=0.0)] = 0.001
    # Points known worse than this part of their distance say nothing about a position.
    max_depth_error: _Positive = 0.5
    # Stored of each keyframe, in equal shares over the image; what more views share comes first.
    # With depth samples and labels they keep a keyframe below 50 kB; places were found as well and
    # as exactly with 580, in rooms and along a street.
    max_stored_features: Annotated[int, msgspec.Meta(ge=1, le=60000)] = 500
    max_depth_samples: _Count = 240
