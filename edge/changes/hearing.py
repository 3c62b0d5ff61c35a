# SPDX-License-Identifier: Apache-2.0
"""What one image says of an object of the map: by masks first, and by the object's own points."""

from collections.abc import Sequence

import numpy as np

from edge.changes.cover import find_held, grown, is_solid, mask_of, reaches
from edge.changes.expect import Expectation, Sighting
from edge.changes.explain import Shown
from edge.changes.glimpse import Glimpse
from edge.changes.known import Known
from edge.changes.portrait import is_as_portrayed
from edge.changes.proof import CONFIRMED, CONTRADICTED, Proof
from edge.geometry.camera import CameraModel
from edge.types import Evidence, Look

_MAX_EVIDENCE = 60
_DOUBTFUL_POINTS = 3  # of an object, that show that it may be there
_SURE_POINTS = 4  # that show that it is, or that something else is where it was
_OFTENER = 4  # times as many of them tell so as tell the opposite
# How surely points of what is there would not all look like something else.
_POINTS_RATE = 0.7
_ERROR_PX = 2  # of pose and mask


def hear(
    known: Known,
    found: Expectation,
    look: Look,
    proof: Proof,
    sighting: Sighting,
    camera: CameraModel,
) -> None:
    """Take what masks say of an object, and what points do where masks may be wrong."""
    mask = mask_of(found.pixels[found.visible], camera)
    own = np.empty(0, np.int32) if mask is None else proof.on(known.points, mask)
    verdict = proof.verdict[own]
    same, other = int((verdict == CONFIRMED).sum()), int((verdict == CONTRADICTED).sum())
    is_other = other >= _SURE_POINTS and other > _OFTENER * same
    if sighting == "missed" or (sighting == "seen" and is_other):
        known.hear_points(proof.points[own], verdict)
    if sighting == "seen" and is_other:
        sighting = "unclear"  # the mask is of what lies there now
    elif sighting == "missed" and (
        (same >= _SURE_POINTS and same > other)
        or is_as_portrayed(known.thing, look.image, camera, look.T_map_cam)
    ):
        sighting = "seen"  # the model blinked: the image shows its very points, or all of it
    elif sighting == "missed" and same >= _DOUBTFUL_POINTS and same >= other:
        sighting = "unclear"
    # Mask and points fail apart: both must, for what is there to be missed.
    # What is hidden in part is missed the more often.
    hit_rate = found.hit_rate * float(found.visible.mean())
    rate = 1.0 - (1.0 - hit_rate) * (1.0 - _POINTS_RATE * is_other)
    origin = look.T_map_cam[:3, 3]
    distance = float(np.linalg.norm(origin - known.thing.center))
    known.presence.add(sighting, origin, distance, rate)
    if sighting == "missed" and len(known.evidence) < _MAX_EVIDENCE:
        known.evidence.append(Evidence(look.index, look.t_ns, look.T_map_cam, mask))


def lay_bare(
    part: Shown, found: Expectation, look: Look, seen: Sequence[Glimpse], alike_deg: float
) -> None:
    """Take what masks of its kind about an object leave of it; nothing where there are none.

    Then the model may have blinked. Masks of another name hide what they cover. What a mask held
    in the map's image from a direction as near as `alike_deg` counts apart, too.
    """
    known = part.known
    alike = (g.mask for g in seen if g.label == known.thing.label and is_solid(g.mask))
    near = [mask for m in alike if reaches(mask := grown(m, _ERROR_PX), part.low, part.high)]
    if not near:
        return
    others = [grown(g.mask, _ERROR_PX) for g in seen if g.label != known.thing.label]
    tested = found.visible & ~find_held(others, found.pixels)
    origin = look.T_map_cam[:3, 3]
    distance_m = float(np.linalg.norm(origin - known.thing.center))
    viewpoint = known.presence.viewpoint(origin, distance_m)
    held = find_held(near, found.pixels)
    known.carving.add(viewpoint, tested, held)
    before = known.held_from(found.direction, alike_deg)
    if before is not None:
        known.carving_alike.add(viewpoint, tested & before, held)
        if len(known.evidence_alike) < _MAX_EVIDENCE:
            known.evidence_alike.append(Evidence(look.index, look.t_ns, look.T_map_cam, None))
