# SPDX-License-Identifier: Apache-2.0
"""Depths of features from the right camera of a stereo pair."""

import numpy as np

from edge.cameras.recording import Recording
from edge.config.features import OrbConfig
from edge.errors import RecordingError
from edge.geometry import se3
from edge.geometry.rectify import rectify
from edge.relocalise.features import Features, OrbExtractor
from edge.types import F64, U8
from maps.matching import match, match_side
from maps.settings import BuildSettings

# Measured on EuRoC against points of five views and more: 0.33 px at octave 0.
_SIGMA_DISPARITY_PX = 0.4
_MIN_DISPARITY_PX = 1.0


class StereoMatcher:
    """Finds the left image's features in the right image."""

    def __init__(self, recording: Recording, extractor: OrbConfig) -> None:
        left, right, T_left_right = (
            recording.camera,
            recording.right_camera,
            recording.T_left_right,
        )
        if right is None or T_left_right is None:
            raise RecordingError(
                f"{recording.root}: has no right camera; --depth stereo needs right/ and "
                "camera_right.toml with T_left_right"
            )
        self._rig = rectify(left, right, T_left_right)
        self._T_right_left = se3.inverse(T_left_right)
        self._extractor = OrbExtractor(extractor)
        self._settings = BuildSettings()

    def depths(self, features: Features, right_image: U8) -> tuple[F64, F64]:
        """Depth (n,) along the left camera's z and its deviation (n,); 0 where unknown."""
        config, rig = self._extractor.config, self._rig
        found = self._extractor.extract(right_image, rig.right)
        sides = []
        for each, camera in ((features, rig.left), (found, rig.right)):
            unknown = np.zeros(len(each.pixels))
            sides.append(match_side(each, camera.pinhole, config, unknown, unknown))
        matches = match(sides[0], sides[1], self._T_right_left, self._settings)
        u_left, v_left = rig.rectify_left(features.raw_pixels[matches.first].astype(np.float64)).T
        u_right, v_right = rig.rectify_right(found.raw_pixels[matches.second].astype(np.float64)).T
        scale = config.scale_factor ** np.maximum(
            features.octave[matches.first], found.octave[matches.second]
        ).astype(np.float64)
        disparity = u_left - u_right
        good = disparity > np.maximum(_MIN_DISPARITY_PX, 2.0 * _SIGMA_DISPARITY_PX * scale)
        good &= np.abs(v_left - v_right) < self._settings.epipolar_px * scale
        rows, disparity = matches.first[good], disparity[good]
        along = rig.pinhole.fx * rig.baseline_m / disparity
        # From the rectified camera's z axis to the left camera's own.
        x = (u_left[good] - rig.pinhole.cx) / rig.pinhole.fx
        y = (v_left[good] - rig.pinhole.cy) / rig.pinhole.fy
        z_per_along = np.column_stack((x, y, np.ones_like(x))) @ rig.R_rect_left[:, 2]
        depth, sigma = np.zeros(len(features.pixels)), np.zeros(len(features.pixels))
        depth[rows] = along * z_per_along
        sigma[rows] = depth[rows] * _SIGMA_DISPARITY_PX * scale[good] / disparity
        return depth, sigma
