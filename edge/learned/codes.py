# SPDX-License-Identifier: Apache-2.0
"""Descriptors as codes of 256 bits, so that they are stored and compared as ORB's are.

Each bit says on which side of a plane through a common origin a descriptor lies: the share of
bits that differ is the angle between two descriptors, by half a turn. The planes are rows of
Hadamard matrices whose signs were shuffled twice, so that they are at right angles as far as the
dimensions go, and equal on every machine.
"""

import numpy as np

from edge.types import F32, U8

BITS = 256
_SEED = 256


def planes(dimensions: int) -> F32:
    """Normals (256, d) of the planes."""
    rng = np.random.default_rng(_SEED)
    size = 1 << (dimensions - 1).bit_length()
    H = _hadamard(size)
    blocks = []
    for _ in range(-(-BITS // size)):
        first, second = rng.choice((-1.0, 1.0), (2, size))
        blocks.append((H * first) @ (H * second))
    rows = np.concatenate(blocks)[:BITS, :dimensions]
    return np.ascontiguousarray(rows / size, np.float32)


def encode(descriptors: F32, origin: F32, normals: F32) -> U8:
    """Codes (n, 32), bit 0 of byte 0 first, of descriptors (n, d) around an origin (d,)."""
    side = (descriptors - origin) @ normals.T > 0.0
    return np.packbits(side, axis=1, bitorder="little")


def _hadamard(size: int) -> F32:
    H = np.ones((1, 1), np.float32)
    while len(H) < size:
        H = np.block([[H, H], [H, -H]])
    return H
