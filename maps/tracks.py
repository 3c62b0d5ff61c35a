# SPDX-License-Identifier: Apache-2.0
"""Corners followed over views."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.types import I32
from maps import kernels_tracks
from maps.matching import Matches

I64 = NDArray[np.int64]


class Tracks(NamedTuple):
    """Observations sorted by track; those of a track by view."""

    offsets: I64  # (n + 1,)
    view: I32  # (m,)
    feature: I32  # (m,)


def join(
    counts: list[int],
    pairs: Iterable[tuple[int, int, Matches]],
    with_depth: list[NDArray[np.bool_]],
) -> Tracks:
    """Tracks of matches between views; features with a depth make a track alone, too.

    counts : features of each view
    pairs : view, view, and their matches
    with_depth : for each view (n,) which features have a depth of their own
    """
    base = np.concatenate([[0], np.cumsum(counts)])
    empty = np.empty(0, np.int64)
    joined: list[tuple[I64, I64, NDArray[np.signedinteger]]] = [(empty, empty, empty)]
    joined += [(base[i] + m.first, base[j] + m.second, m.bits) for i, j, m in pairs]
    first, second, bits = (np.concatenate(column) for column in zip(*joined, strict=True))
    trust = np.argsort(bits, kind="stable")
    total = int(base[-1])
    image = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    parent, last = np.arange(total), np.arange(total)
    following = np.full(total, -1)
    stamp = np.full(len(counts), -1)
    kernels_tracks.unite(first[trust], second[trust], image, parent, following, last, stamp)
    leader = np.empty(total, np.int64)
    kernels_tracks.flatten(parent, leader)
    sizes = np.bincount(leader, minlength=total)
    wanted = np.flatnonzero((sizes[leader] > 1) | np.concatenate(with_depth))
    order = wanted[np.argsort(leader[wanted], kind="stable")]
    starts = np.flatnonzero(np.diff(leader[order], prepend=-1))
    return Tracks(
        offsets=np.append(starts, len(order)),
        view=image[order],
        feature=(order - base[image[order]]).astype(np.int32),
    )
