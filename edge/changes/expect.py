# SPDX-License-Identifier: Apache-2.0
"""Whether an object of the map must be seen in an image: else not seeing it says nothing."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from edge.changes.cover import between, holds
from edge.config.changes import PresenceConfig
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject
from edge.types import F32, F64, Bools, Mask, Mat4

Reason: TypeAlias = Literal["expected", "outside", "hidden", "small", "far", "other side"]
Sighting: TypeAlias = Literal["seen", "missed", "unclear"]


@dataclass(frozen=True, slots=True, eq=False)
class Expectation:
    """What an image must show of an object."""

    reason: Reason
    pixels: F32  # (n, 2) where its points would be, in the camera's own image; nan beyond its lens
    visible: Bools  # (n,) which of them are inside, and nothing hides if it is expected
    direction: F64  # (3,) unit, from the object to the camera
    hit_rate: float  # how often the map's images from about there found it; 0 if not expected

    @property
    def holds(self) -> bool:
        """Whether it must be seen."""
        return self.reason == "expected"


# Depth (n,) of the nearest surface known about pixels (n, 2), of the map or measured now, at which
# points lie at depths (n,); NaN where nothing is known, or nothing that is nearer than they.
Surface: TypeAlias = Callable[[F64, F64], F64]


def expect(
    thing: MapObject,
    T_map_cam: Mat4,
    camera: CameraModel,
    surface: Surface,
    config: PresenceConfig,
) -> Expectation:
    """Whether the camera at this pose must see the object, and why not."""
    local = (thing.points - T_map_cam[:3, 3]) @ T_map_cam[:3, :3]
    pixels = camera.project(local)
    to_camera = T_map_cam[:3, 3] - thing.center
    distance = float(np.linalg.norm(to_camera))
    direction: F64 = to_camera / max(distance, 1e-9)
    border = config.border_px
    limit = (camera.width - 1.0 - border, camera.height - 1.0 - border)
    visible = between(pixels, (border, border), limit)
    reason: Reason = "expected"
    if visible.mean() < config.visible_share:
        reason = "outside"
    elif distance > config.range_factor * thing.view_distance_m:
        reason = "far"
    elif _is_other_side(thing, direction, config):
        reason = "other side"
    else:  # what hides it takes longest to find
        # A comparison with NaN is false: what nobody knows does not hide anything.
        visible &= ~(surface(pixels, local[:, 2]) < local[:, 2] * (1.0 - config.depth_tolerance))
        if visible.mean() < config.visible_share:
            reason = "hidden"
        elif _is_small(pixels[visible], config):
            reason = "small"
    hit_rate = _hit_rate(thing, T_map_cam[:3, 3], config) if reason == "expected" else 0.0
    return Expectation(reason, pixels.astype(np.float32), visible, direction, hit_rate)


def _is_other_side(thing: MapObject, direction: F64, config: PresenceConfig) -> bool:
    cosine = float((thing.view_directions @ direction)[thing.found].max())
    return cosine < math.cos(math.radians(config.view_angle_deg))


def _hit_rate(thing: MapObject, origin: F64, config: PresenceConfig) -> float:
    """How often the map's nearest images found it; its rate from everywhere counts as one.

    What is rarely found anywhere is not expected from where chance found it a few times.
    """
    if thing.hit_rate < config.lowest_hit_rate:
        return thing.hit_rate
    apart = np.linalg.norm(thing.cameras - origin, axis=1)
    nearest = np.argsort(apart, kind="stable")[: config.alike_views]
    return float((thing.chances[nearest].sum() + thing.hit_rate) / (len(nearest) + 1.0))


def _is_small(pixels: F64, config: PresenceConfig) -> bool:
    """Whether the box around them is too small or too thin to be found surely."""
    extent = pixels.max(axis=0) - pixels.min(axis=0)
    return bool(extent.prod() < config.min_size_px or extent.min() < config.min_side_px)


def sight(
    expectation: Expectation, own: Sequence[Mask], unknown: Sequence[Mask], config: PresenceConfig
) -> Sighting:
    """Whether the image shows the object, by masks that may be `own` and by those of nobody knows.

    Masks of what is known to stand elsewhere say nothing, wherever they lie.
    """
    pixels = expectation.pixels[expectation.visible]
    share, doubtful = (
        max((float(holds(mask, pixels).mean()) for mask in masks), default=0.0)
        for masks in (own, unknown)
    )
    if share >= config.seen_share:
        return "seen"
    return "missed" if max(share, doubtful) <= config.missed_share else "unclear"
