# SPDX-License-Identifier: Apache-2.0
"""How the user's segmentation model is run."""

from typing import Annotated

from msgspec import Meta, Struct

from edge.config.threads import Cpus


class SegmenterConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What counts as seen, and what the model's process may take."""

    # An instance-segmentation model (ONNX); empty: none. Its classes are those of the map's labels.
    model: str = ""
    # Below it detectors guess; changes are believed over several views only, so it may be low.
    # Weaker masks, down to 0.1, begin nothing: they tell of what is followed already.
    min_score: Annotated[float, Meta(ge=0.01, le=1.0)] = 0.25
    # Share of union above which two boxes are one object, whatever they are called.
    same_overlap: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.6
    # Classes that move by themselves: kept out of the odometry and of maps.
    moving: tuple[str, ...] = (
        "person", "bird", "cat", "dog", "bicycle", "car", "motorcycle", "bus", "truck",
    )  # fmt: skip
    # Bounds the time of masks; a room shows some dozens.
    max_objects: Annotated[int, Meta(ge=1, le=300)] = 100
    # Cores that its process may use; empty: any.
    cpus: Cpus = ()
    # Below everything that makes poses.
    nice: Annotated[int, Meta(ge=0, le=19)] = 15
    # Of its data; a 320 px model takes a fifth of it.
    memory_mb: Annotated[int, Meta(ge=128, le=16384)] = 1024
    # From the start of the process to the end of its dry run, on a slow card.
    start_timeout_s: Annotated[float, Meta(ge=1.0, le=600.0)] = 60.0
    # An image that takes longer never comes: the process is ended and started anew.
    image_timeout_s: Annotated[float, Meta(ge=0.1, le=600.0)] = 20.0
    # Wait before a new start; doubled each time until `longest_wait_s`.
    first_wait_s: Annotated[float, Meta(ge=0.0, le=600.0)] = 1.0
    longest_wait_s: Annotated[float, Meta(ge=0.0, le=3600.0)] = 60.0
