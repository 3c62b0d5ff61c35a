# SPDX-License-Identifier: Apache-2.0
"""Joins pairwise matches into tracks that hold at most one feature of an image."""

from edge.kernel import inline_kernel, kernel


@inline_kernel
def _root(parent, node):  # type: ignore[no-untyped-def]
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


@kernel
def unite(first, second, image, parent, following, last, stamp):  # type: ignore[no-untyped-def]
    """Unite the features of each match, best match first, where no image would be twice in a track.

    first, second  (m,)  int64  features of the matches, in order of trust
    image          (n,)  int32  of each feature
    parent         (n,)  int64, in: 0..n-1; out: a forest
    following      (n,)  int64, in: -1; out: the next member of the same track
    last           (n,)  int64, in: 0..n-1; out: at a root, the last member
    stamp          (k,)  int64  scratch by image, in: -1
    """
    for m in range(first.shape[0]):
        a, b = _root(parent, first[m]), _root(parent, second[m])
        if a == b:
            continue
        node = a
        while node >= 0:
            stamp[image[node]] = m
            node = following[node]
        node, clash = b, False
        while node >= 0:
            clash = clash or stamp[image[node]] == m
            node = following[node]
        if clash:
            continue
        # The lower feature leads, so that the result does not depend on who was first.
        if b < a:
            a, b = b, a
        parent[b] = a
        following[last[a]] = b
        last[a] = last[b]


@kernel
def flatten(parent, out):  # type: ignore[no-untyped-def]
    """Overwrite out (n,) int64 with the leading feature of each feature's track."""
    for node in range(parent.shape[0]):
        out[node] = _root(parent, node)
