# SPDX-License-Identifier: Apache-2.0
"""Which part of an object has gone while the rest of it is there.

Two things that touch are one object of the map where one mask held both in all of its images. From
directions as these were taken from, the outline of what is there fills that of the object; what
masks leave bare then, from viewpoint to viewpoint, is gone. From other sides the object's space is
larger than the thing, as the masks that carved it were seen from one side.
"""

import numpy as np

from edge.changes.carving import Carving
from edge.types import F64, Bools

_VIEWPOINTS = 8  # that must tell of a place
_BARE, _HELD = -0.5, 0.2  # of the viewpoints, by how many more hold a place than see it bare
_LEAST_BARE, _LEAST_HELD = 0.1, 0.3  # of the object
_APART = 0.98  # of pairs of a bare place and a held one, one plane orders so many
_THINNEST, _THICKEST = 0.2, 0.6  # the part, of the object's depth across that plane
_LEAST_M = 0.05  # thinner is what poses and masks err by


def parted(points: F64, carving: Carving) -> Bools | None:
    """Which of an object's points (n, 3) [m] are of a part that is gone (n,); None where none is.

    `carving` is of directions as those from which the map's images found the object.
    """
    if carving.n_viewpoints < _VIEWPOINTS:
        return None
    share = carving.held_share(_VIEWPOINTS)
    bare, held = share <= _BARE, share >= _HELD
    if bare.mean() < _LEAST_BARE or held.mean() < _LEAST_HELD:
        return None
    along = points @ _between(points[bare], points[held])
    before = np.searchsorted(np.sort(along[held]), along[bare])
    if before.mean() < _APART * np.count_nonzero(held):
        return None
    thick, whole = float(np.ptp(along[bare])), float(np.ptp(along))
    if not max(_LEAST_M, _THINNEST * whole) <= thick <= _THICKEST * whole:
        return None
    part: Bools = along >= along[bare].min()
    return part


def _between(bare: F64, held: F64) -> F64:
    """The normal (3,) of the plane that best has bare places on one side (Fisher 1936)."""
    scatter = len(bare) * np.cov(bare.T) + len(held) * np.cov(held.T)
    scatter += 1e-9 * max(float(np.trace(scatter)), 1e-12) * np.eye(3)
    normal: F64 = np.linalg.solve(scatter, bare.mean(axis=0) - held.mean(axis=0))
    return normal / np.linalg.norm(normal)
