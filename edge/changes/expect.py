# SPDX-License-Identifier: Apache-2.0
"""Whether an object of the map must be seen in an image: else not seeing it says nothing."""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from edge.changes.cover import find_cover
from edge.config.changes import PresenceConfig
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject
from edge.types import F32, F64, Bools, Detections, Mat4

Reason: TypeAlias = Literal["expected", "outside", "hidden", "small", "far", "other side"]
Sighting: TypeAlias = Literal["seen", "missed", "unclear"]


@dataclass(frozen=True, slots=True, eq=False)
class Expectation:
    """What an image must show of an object."""

    reason: Reason
    pixels: F32  # (n, 2) where its points would be, in the camera's own image; nan beyond its lens
    visible: Bools  # (n,) which of them nothing hides
    direction: F64  # (3,) unit, from the object to the camera
    hit_rate: float  # how often the map's images from about there found it

    @property
    def holds(self) -> bool:
        """Whether it must be seen."""
        return self.reason == "expected"


def expect(
    thing: MapObject,
    T_map_cam: Mat4,
    camera: CameraModel,
    surface_m: F64,
    config: PresenceConfig,
) -> Expectation:
    """Whether the camera at this pose must see the object, and why not.

    `surface_m` (n,) is the depth of the nearest surface known at each point's pixel, of the map
    without the object or measured now; NaN where nothing is known.
    """
    local = (thing.points - T_map_cam[:3, 3]) @ T_map_cam[:3, :3]
    pixels = camera.project(local).astype(np.float32)
    to_camera = T_map_cam[:3, 3] - thing.center
    distance = float(np.linalg.norm(to_camera))
    direction: F64 = to_camera / max(distance, 1e-9)
    border = config.border_px
    limit = np.array([camera.width, camera.height]) - 1.0 - border
    # A comparison with NaN is false: beyond the lens is not inside, and what nobody knows does
    # not hide anything.
    inside = ((pixels >= border) & (pixels <= limit)).all(axis=1)
    visible: Bools = inside & ~(surface_m < local[:, 2] * (1.0 - config.depth_tolerance))
    cosines = thing.view_directions @ direction
    cosine = float(cosines[thing.found].max())
    reason: Reason = "expected"
    if inside.mean() < config.visible_share:
        reason = "outside"
    elif visible.mean() < config.visible_share:
        reason = "hidden"
    elif _is_small(pixels[visible], config):
        reason = "small"
    elif distance > config.range_factor * thing.view_distance_m:
        reason = "far"
    elif cosine < math.cos(math.radians(config.view_angle_deg)):
        reason = "other side"
    return Expectation(
        reason, pixels, visible, direction, _hit_rate(thing, T_map_cam[:3, 3], config)
    )


def _hit_rate(thing: MapObject, origin: F64, config: PresenceConfig) -> float:
    """How often the map's nearest images found it; its rate from everywhere counts as one.

    What is rarely found anywhere is not expected from where chance found it a few times.
    """
    if thing.hit_rate < config.lowest_hit_rate:
        return thing.hit_rate
    apart = np.linalg.norm(thing.cameras - origin, axis=1)
    nearest = np.argsort(apart, kind="stable")[: config.alike_views]
    return float((thing.found[nearest].sum() + thing.hit_rate) / (len(nearest) + 1.0))


def _is_small(pixels: F32, config: PresenceConfig) -> bool:
    """Whether the box around them is too small or too thin to be found surely."""
    extent = pixels.max(axis=0) - pixels.min(axis=0)
    return bool(extent.prod() < config.min_size_px or extent.min() < config.min_side_px)


def sight(expectation: Expectation, detections: Detections, config: PresenceConfig) -> Sighting:
    """Whether the image shows the object: by place, for detectors rename things."""
    owner = find_cover(detections, expectation.pixels[expectation.visible])
    counts = np.bincount(owner[owner >= 0], minlength=1)
    share = float(counts.max()) / max(len(owner), 1)
    if share >= config.seen_share:
        return "seen"
    return "missed" if share <= config.missed_share else "unclear"
