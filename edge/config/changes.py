# SPDX-License-Identifier: Apache-2.0
"""When an object of the map counts as gone."""

from typing import Annotated

from msgspec import Meta, Struct, field

Share = Annotated[float, Meta(ge=0.0, le=1.0)]


class PresenceConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What it takes to expect an object in an image, and to believe that it is not there."""

    # Points closer to the border are not asked for: masks end there early.
    border_px: Annotated[float, Meta(ge=0.0, le=200.0)] = 8.0
    # Of an object's points; a mask of less is often missed.
    visible_share: Share = 0.6
    # Apparent size of the box: specks come and go in any model, and in another light all at once.
    min_size_px: Annotated[float, Meta(ge=1.0, le=1e6)] = 80.0
    # Errors of pose and mask of some pixels move what is thinner beside its mask.
    min_side_px: Annotated[float, Meta(ge=1.0, le=1e3)] = 4.0
    # Times the largest distance from which the map's own images saw it.
    range_factor: Annotated[float, Meta(ge=1.0, le=10.0)] = 1.3
    # From the nearest direction the map's own images saw it: another side may look like nothing.
    view_angle_deg: Annotated[float, Meta(gt=0.0, le=180.0)] = 40.0
    # The nearest so many images of the map tell how often the model finds it from there.
    alike_views: Annotated[int, Meta(ge=1, le=1000)] = 5
    # Nearer by more than this share, something stands before it.
    depth_tolerance: Share = 0.08
    # Of visible points under one mask: from here on it is seen, below the lower it is missed.
    seen_share: Share = 0.4
    missed_share: Share = 0.1
    # How often a model sees what is not there, at a given place.
    false_rate: Annotated[float, Meta(gt=0.0, lt=0.5)] = 0.05
    # Bounds what the map says of how often the model finds an object: nothing is certain, and
    # what it rarely finds, it does not find at all in another light.
    lowest_hit_rate: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.35
    highest_hit_rate: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.9
    # Scores in the map: from the first on the model finds a thing again, up to the second never.
    sure_score: Share = 0.4
    guessed_score: Share = 0.1
    # Images from one place fail together; so much is the most that a viewpoint can say.
    viewpoint_log_odds: Annotated[float, Meta(gt=0.0, le=20.0)] = 2.0
    # Another viewpoint begins so far from all others, as a part of the distance to the object.
    viewpoint_share: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.035
    # Gone below this, over so many viewpoints that say so.
    gone_log_odds: Annotated[float, Meta(lt=0.0, ge=-100.0)] = -3.5
    gone_viewpoints: Annotated[int, Meta(ge=1, le=100)] = 3
    # What is new begins at `new_log_odds` and must reach this.
    new_log_odds: Annotated[float, Meta(lt=0.0, ge=-100.0)] = -3.0
    there_log_odds: Annotated[float, Meta(gt=0.0, le=100.0)] = 2.5
    there_viewpoints: Annotated[int, Meta(ge=1, le=100)] = 3
    # As many masks of it must hold so many pixels: specks are found anywhere.
    there_px: Annotated[int, Meta(ge=1, le=1_000_000)] = 100


class ProofConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How points of the map are looked for at their very place in an image."""

    # Bounds the time; points on objects and under masks come first.
    max_points: Annotated[int, Meta(ge=1, le=100_000)] = 500
    # Keyframes whose points are asked for, and what counts as near them.
    keyframes: Annotated[int, Meta(ge=1, le=100)] = 8
    near_m: Annotated[float, Meta(gt=0.0, le=1e4)] = 1.5
    near_deg: Annotated[float, Meta(gt=0.0, le=180.0)] = 40.0
    # A patch of the image beyond these looks different anyway.
    angle_deg: Annotated[float, Meta(gt=0.0, le=90.0)] = 25.0
    octaves: Annotated[int, Meta(ge=0, le=8)] = 2
    # Of a descriptor's patch at octave 0.
    border_px: Annotated[float, Meta(ge=16.0, le=100.0)] = 20.0
    # Errors of pose and point move the place by some pixels.
    search_steps: Annotated[int, Meta(ge=0, le=5)] = 2
    step_px: Annotated[float, Meta(gt=0.0, le=10.0)] = 2.0
    # Of 256: the same patch differs by less, another by more even at the best of all places.
    same_bits: Annotated[int, Meta(ge=0, le=256)] = 64
    other_bits: Annotated[int, Meta(ge=0, le=256)] = 76


class GeometryConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What changes are told by without a model: rather too few than wrong ones."""

    # Surfaces are compared in cubes of this side: no finer than poses and depths are.
    cell_m: Annotated[float, Meta(ge=0.005, le=10.0)] = 0.05
    # Depths are compared so far from the camera.
    range_m: Annotated[float, Meta(ge=0.1, le=1e3)] = 3.5
    # Deviation of a measured depth, as a share of it, at most.
    depth_share: Annotated[float, Meta(gt=0.0, le=0.2)] = 0.03
    # Viewpoints that must see through a cube, or something in it.
    views: Annotated[int, Meta(ge=2, le=12)] = 3
    # Cubes that must have gone together, or have come.
    gone_cells: Annotated[int, Meta(ge=3, le=1000)] = 8
    new_cells: Annotated[int, Meta(ge=3, le=1000)] = 6
    # Depths of the map that lie behind each new cube, on average: what is narrow, some miss.
    seen_through: Annotated[int, Meta(ge=1, le=1000)] = 16
    # Of those, from directions so near to the live ones: a table is thin from its side.
    direction_deg: Annotated[float, Meta(gt=0.0, le=90.0)] = 30.0
    # Points of the map, before which there is surely something new where a model sees it.
    hidden_points: Annotated[int, Meta(ge=1, le=1000)] = 4
    # Points that are compared in an image, and how far beside the map's views.
    max_points: Annotated[int, Meta(ge=1, le=100_000)] = 600
    angle_deg: Annotated[float, Meta(gt=0.0, le=90.0)] = 15.0
    # Points seen by few images or from one direction are often wrong.
    point_views: Annotated[int, Meta(ge=2, le=100)] = 4
    point_parallax_deg: Annotated[float, Meta(ge=0.0, le=90.0)] = 3.0


class ChangesConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What counts as a change, and how often it is looked for."""

    # Images are looked at so often, and as the model is free.
    interval_s: Annotated[float, Meta(ge=0.0, le=3600.0)] = 0.2
    # In a replay, what a look tells takes effect so many frames later.
    delay_frames: Annotated[int, Meta(ge=0, le=1000)] = 6
    # Classes that may come and go; empty: all but those ignored.
    movable: tuple[str, ...] = ()
    # Classes that walk by: never reported, and what they hide is not missed.
    ignored: tuple[str, ...] = (
        "person", "bird", "cat", "dog", "bicycle", "car", "motorcycle", "bus", "truck",
    )  # fmt: skip
    # A pose less sure than this puts masks on the wrong things.
    pose_sigma_m: Annotated[float, Meta(gt=0.0, le=100.0)] = 0.1
    # Share of the map's points under a mask that are shown as they were: nothing is new there.
    same_share: Share = 0.2
    # Map images that must have shown a new thing, and the share of them that may have, weakly.
    free_views: Annotated[int, Meta(ge=0, le=1000)] = 3
    # From so near the live directions: models do not know things from another side.
    free_view_deg: Annotated[float, Meta(gt=0.0, le=180.0)] = 12.0
    weak_share: Share = 0.15
    # Points of the map that may lie where a new thing is: with more, something was there.
    free_points: Annotated[int, Meta(ge=0, le=1000)] = 1
    # Deviation of a new thing's place, at most: this, and a part of its distance.
    place_sigma_m: Annotated[float, Meta(gt=0.0, le=1e3)] = 0.02
    place_share: Share = 0.02
    # A thing that is gone here and one of its kind that is new so near: moved.
    moved_m: Annotated[float, Meta(ge=0.0, le=1e4)] = 3.0
    # Look for what the map's points alone show, without any model: less sure.
    without_model: bool = False
    presence: PresenceConfig = field(default_factory=PresenceConfig)
    proof: ProofConfig = field(default_factory=ProofConfig)
    geometry: GeometryConfig = field(default_factory=GeometryConfig)
