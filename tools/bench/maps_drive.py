# SPDX-License-Identifier: Apache-2.0
"""A long drive between house fronts, as features and geometry: nothing is rendered.

Corners stand on both sides of a winding street. Each is known over a range of distances, as ORB
knows it, with noise in its place, its descriptor and its angle, and is missed now and then; a part
of the features belongs to nothing. Descriptors are leaves of the vocabulary with bits flipped, so
that words are as common as they are in real images.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.config.features import OrbConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.relocalise import bow
from edge.relocalise.bow import shipped_vocabulary
from edge.relocalise.features import Features
from edge.tiles import format as tile_format
from edge.types import F64, U8, DepthSamples, Mat4
from maps.describe import Description

CAMERA = CameraModel(1241, 376, 718.9, 718.9, 607.2, 185.2)  # as KITTI's
STEP_M = 3700.0 / 4541.0
CORNERS_PER_M = 185.0
CLUTTER = 0.25  # of the features of an image
NEAR_M, FAR_M = 6.0, 40.0  # at which corners are known best
REACH = 1.3  # factor nearer and farther at which they are known at all
SEEN = 0.6  # of the times
CORNER_PX = 0.35  # at octave 0
FLIPPED = 0.06  # of the bits, from image to image
OF_LEAF = 0.08  # of the bits, from the vocabulary's leaf


class Street(NamedTuple):
    """Corners, by where along the street they stand."""

    along: F64  # (n,) ascending [m]
    xyz: F64  # (n, 3)
    best_m: F64  # (n,) distance
    octave: NDArray[np.int64]  # (n,) at that distance
    angle: F64  # (n,)
    descriptors: U8  # (n, 32)


def pose(along: float) -> Mat4:
    """T_map_cam of a camera that looks along the street; z is up in the map."""
    s = np.linspace(0.0, along, max(2, int(along / 2.0) + 2))
    heading = _heading(s)
    x, y = np.trapezoid(np.cos(heading), s), np.trapezoid(np.sin(heading), s)
    forward = np.array((np.cos(heading[-1]), np.sin(heading[-1]), 0.0))
    down = np.array((0.0, 0.0, -1.0))
    R = np.stack((np.cross(down, forward), down, forward), axis=1)
    return se3.from_rotation_translation(R, np.array((x, y, 1.65)))


def _heading(s: F64) -> F64:
    """A grid of streets with bends: a turn of 90 degrees some 150 m apart."""
    turn = np.floor(s / 150.0) + 1.0 / (1.0 + np.exp(-np.clip((s % 150.0 - 140.0), -50, 50)))
    sign = np.cumsum(np.where(np.arange(200) % 3 == 2, -1.0, 1.0))
    at = np.clip(turn, 0, 198)
    low = np.floor(at).astype(int)
    level = np.concatenate(([0.0], sign))
    return 0.5 * np.pi * (level[low] + (at - low) * (level[low + 1] - level[low]))


def street(length_m: float, seed: int = 0) -> Street:
    """Corners along `length_m` and a little more."""
    rng = np.random.default_rng(seed)
    n = int((length_m + 60.0) * CORNERS_PER_M)
    along = np.sort(rng.uniform(0.0, length_m + 60.0, n))
    aside = rng.uniform(5.0, 13.0, n) * rng.choice((-1.0, 1.0), n)
    steps = np.arange(0.0, length_m + 61.0, 0.5)
    T = np.array([pose(s) for s in steps])
    row = np.minimum((along / 0.5).astype(int), len(steps) - 1)
    xyz = T[row, :3, 3] + aside[:, None] * T[row, :3, 0]
    xyz[:, 2] = rng.uniform(0.0, 7.0, n)
    leaves = _leaves()
    descriptors = flipped(leaves[rng.integers(0, len(leaves), n)], OF_LEAF, rng)
    best_m = np.exp(rng.uniform(np.log(NEAR_M), np.log(FAR_M), n))
    octave = np.minimum(rng.geometric(0.3, n) - 1, 6)
    return Street(along, xyz, best_m, octave, rng.uniform(0, 2 * np.pi, n), descriptors)


def _leaves() -> U8:
    """Centres of the vocabulary's words (n, 32)."""
    path = Path(bow.__file__).with_name("vocabulary.tile")
    arrays, _ = tile_format.decode(memoryview(path.read_bytes()), str(path))
    return np.asarray(arrays["nodes"][arrays["n_children"] == 0])


def views(
    made: Street, length_m: float, step_m: float = STEP_M, offset_m: float = 0.0, seed: int = 1
) -> Iterator[tuple[Mat4, Features]]:
    """Pose and features of images along the street; `offset_m` aside of its middle."""
    rng = np.random.default_rng(seed)
    scale = OrbConfig().scale_factor
    for along in np.arange(0.0, length_m, step_m):
        T = pose(along)
        T[:3, 3] += offset_m * T[:3, 0]
        begin, end = np.searchsorted(made.along, (along, along + 60.0))
        local = se3.transform(se3.inverse(T), made.xyz[begin:end])
        pixels = CAMERA.project(local)
        nearer = made.best_m[begin:end] / np.maximum(np.linalg.norm(local, axis=1), 1e-9)
        good = (pixels > 16.0).all(axis=1) & (pixels < (CAMERA.width - 16, CAMERA.height - 16)).all(
            axis=1
        )
        good &= (nearer < REACH) & (nearer > 1.0 / REACH) & (rng.random(len(nearer)) < SEEN)
        rows = np.flatnonzero(good)
        octave = made.octave[begin + rows] + np.round(np.log(nearer[rows]) / np.log(scale))
        yield T, _features(made, begin + rows, pixels[rows], np.clip(octave, 0, 7), rng)


def described(features: Features) -> Description:
    """What the compiler knows of an image."""
    nothing = np.zeros(len(features.pixels))
    empty = np.empty(0, np.float32)
    words = shipped_vocabulary().describe(features.descriptors)
    samples = DepthSamples(np.empty((0, 2), np.float32), empty, empty)
    return Description(features, words, nothing, nothing, samples)


def flipped(descriptors: U8, share: float, rng: np.random.Generator) -> U8:
    """Descriptors (n, 32) with a share of their bits turned over."""
    turned = rng.random((len(descriptors), 256), np.float32) < share
    return descriptors ^ np.packbits(turned, axis=1)


def _features(
    made: Street, rows: NDArray[np.int64], pixels: F64, octave: F64, rng: np.random.Generator
) -> Features:
    noise = CORNER_PX * OrbConfig().scale_factor ** octave
    seen = pixels + rng.normal(0.0, 1.0, pixels.shape) * noise[:, None]
    n = int(len(rows) * CLUTTER / (1.0 - CLUTTER))
    clutter = rng.uniform((16, 16), (CAMERA.width - 16, CAMERA.height - 16), (n, 2))
    angle = made.angle[rows] + rng.normal(0.0, 0.05, len(rows))
    others = made.descriptors[rng.integers(0, len(made.descriptors), n)]
    both = np.concatenate([seen, clutter]).astype(np.float32)
    return Features(
        both,
        np.concatenate(
            [flipped(made.descriptors[rows], FLIPPED, rng), flipped(others, 2 * OF_LEAF, rng)]
        ),
        np.concatenate([octave, rng.integers(0, 7, n)]).astype(np.uint8),
        (np.concatenate([angle, rng.uniform(0, 6.28, n)]) % (2 * np.pi)).astype(np.float32),
        both,
    )
