# SPDX-License-Identifier: Apache-2.0
"""Which features of two posed images show the same corner."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.config.features import OrbConfig
from edge.geometry import se3
from edge.relocalise.features import Features
from edge.types import F32, F64, I32, Mat4, Pinhole
from maps.kernels_match import match_one_way
from maps.settings import BuildSettings

# Nearer than this part of the baseline, a corner is seen from sides that differ by over 60 degrees.
_NEAREST_PER_BASELINE = 0.6
_DEPTH_SIGMAS = 4.0  # how far from its given depth a point may lie


class MatchSide(NamedTuple):
    """One image as the matcher takes it."""

    pinhole: Pinhole
    rays: F64  # (n, 3), z = 1
    pixels: F32  # (n, 2) ideal
    bits: NDArray[np.uint64]  # (n, 4)
    angle_rad: F32
    sigma: F32  # (n,) scale of the octave
    depth: F64  # (n,) 0 where unknown
    depth_sigma: F64
    orders: I32  # (2, n) rows sorted by u, and by v


class Matches(NamedTuple):
    """Pairs of features, in the order of the first image's."""

    first: I32
    second: I32
    bits: I32  # that differ


class MatchTask(NamedTuple):
    """One image and those it is matched with."""

    side: MatchSide
    others: tuple[MatchSide, ...]
    T_other_side: F64  # (n, 4, 4)
    settings: BuildSettings


class MatchedSide(NamedTuple):
    """Matches of one image with some others, one after the other."""

    offsets: I32  # (n + 1,)
    first: I32
    second: I32
    bits: I32

    def split(self) -> list[Matches]:
        """Matches with each of the others."""
        ends = self.offsets[1:-1]
        columns = (np.split(column, ends) for column in (self.first, self.second, self.bits))
        return [Matches(*each) for each in zip(*columns, strict=True)]


def match_with_others(task: MatchTask) -> MatchedSide:
    """Match one image with several; runs wherever the work is done."""
    found = [
        match(task.side, other, T, task.settings)
        for other, T in zip(task.others, task.T_other_side, strict=True)
    ]
    counts = [0, *(len(matches.first) for matches in found)]
    columns = (np.concatenate(column) for column in zip(*found, strict=True))
    return MatchedSide(np.cumsum(counts).astype(np.int32), *columns)


def match_side(
    features: Features, pinhole: Pinhole, config: OrbConfig, depth: F64, depth_sigma: F64
) -> MatchSide:
    """Prepare an image for the matcher."""
    centre, focal = (pinhole.cx, pinhole.cy), (pinhole.fx, pinhole.fy)
    normalised = (features.pixels.astype(np.float64) - centre) / focal
    return MatchSide(
        pinhole=pinhole,
        rays=np.column_stack((normalised, np.ones(len(normalised)))),
        pixels=features.pixels,
        bits=features.descriptors.view(np.uint64),
        angle_rad=features.angle_rad,
        sigma=(config.scale_factor**features.octave).astype(np.float32),
        depth=depth,
        depth_sigma=depth_sigma,
        orders=np.argsort(features.pixels, axis=0, kind="stable").T.astype(np.int32, order="C"),
    )


def match(a: MatchSide, b: MatchSide, T_b_a: Mat4, settings: BuildSettings) -> Matches:
    """Matches that are the best both ways, within the band that the poses allow."""
    forward, bits = _one_way(a, b, T_b_a, settings)
    backward, _ = _one_way(b, a, se3.inverse(T_b_a), settings)
    first = np.flatnonzero(forward >= 0)
    first = first[backward[forward[first]] == first].astype(np.int32)
    return Matches(first, forward[first], bits[first])


def _one_way(a: MatchSide, b: MatchSide, T_b_a: Mat4, settings: BuildSettings) -> tuple[I32, I32]:
    near, far = _depth_range(a, float(np.linalg.norm(T_b_a[:3, 3])))
    out, bits = np.empty(len(a.rays), np.int32), np.empty(len(a.rays), np.int32)
    scratch = np.empty((2, len(b.rays)), np.int32)
    limits = np.array(
        [
            settings.epipolar_px,
            settings.max_bits,
            settings.max_ratio,
            np.deg2rad(settings.max_turn_deg),
        ]
    )
    match_one_way(
        a.rays, near, far, a.bits, a.angle_rad, a.sigma,
        b.pixels, b.bits, b.angle_rad, b.sigma, b.orders,
        np.ascontiguousarray(T_b_a[:3, :3]), np.ascontiguousarray(T_b_a[:3, 3]),
        np.array([b.pinhole.fx, b.pinhole.fy, b.pinhole.cx, b.pinhole.cy]),
        limits, scratch[0], scratch[1], out, bits,
    )  # fmt: skip
    return out, bits


def _depth_range(side: MatchSide, baseline: float) -> tuple[F64, F64]:
    near = np.full(len(side.depth), max(_NEAREST_PER_BASELINE * baseline, 1e-6))
    far = np.full(len(side.depth), np.inf)
    known = side.depth > 0.0
    reach = _DEPTH_SIGMAS * side.depth_sigma[known]
    near[known] = np.maximum(side.depth[known] - reach, 1e-6)
    far[known] = side.depth[known] + reach
    return near, far
