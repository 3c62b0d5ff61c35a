# SPDX-License-Identifier: Apache-2.0
"""Square markers that tell where the camera is, or how long a metre is."""

import math
from typing import Annotated

from msgspec import Meta, Struct

_Length = Annotated[float, Meta(gt=0.0, le=100.0)]


class MarkerPlace(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One marker. Its frame: origin in its middle, x right and y up on its print, z towards us."""

    # Its number in the family.
    number: Annotated[int, Meta(ge=0)]
    # Length of its black square's side; 0: as the others.
    side_m: Annotated[float, Meta(ge=0.0, le=100.0)] = 0.0
    # Of its middle in the map; without it the marker tells metres only. Where there is no map, the
    # first marker of the list is its origin, if it has no place.
    position_m: tuple[float, float, float] | None = None
    # Quaternion that turns the marker's axes into those of the map.
    rotation_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Refuse what is no place."""
        if self.position_m is not None and not all(map(math.isfinite, self.position_m)):
            raise ValueError("position_m is no place; give three lengths")
        norm = math.hypot(*self.rotation_xyzw)
        if not 0.9 < norm < 1.1:
            raise ValueError("rotation_xyzw is no unit quaternion; give x, y, z, w")


class MarkersConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Markers that the daemon looks for whenever it looks where it is."""

    # As "4X4_50" or "APRILTAG_36H11"; empty: no marker is looked for.
    family: str = ""
    # Length of the black square's side, where a marker does not say its own.
    side_m: _Length = 0.16
    # Of a corner in the image: by the edges 0.05, and what the lens and a bent sheet add.
    corner_px: Annotated[float, Meta(gt=0.0, le=5.0)] = 0.2
    # Errors of a marker's side, as a share of it: printers stretch.
    side_share: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.002
    # Errors of a marker's place in the map.
    survey_m: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.002
    survey_deg: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.1
    known: tuple[MarkerPlace, ...] = ()
    # Whether those of the map count, too (mapvo-map build --markers), where they are of this family
    # or none is named.
    in_map: bool = True

    def __post_init__(self) -> None:
        """Refuse a list that contradicts itself."""
        numbers = [marker.number for marker in self.known]
        if len(set(numbers)) != len(numbers):
            raise ValueError("known: two markers have one number; leave one out")
        if self.known and not self.family:
            raise ValueError('known: markers are listed, but family is empty; name it, as "4X4_50"')
