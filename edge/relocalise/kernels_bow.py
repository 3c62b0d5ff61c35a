# SPDX-License-Identifier: Apache-2.0
"""Hamming distances and the walk down a vocabulary tree."""

import numpy as np

from edge.kernel import inline_kernel, kernel

_M1 = np.uint64(0x5555555555555555)
_M2 = np.uint64(0x3333333333333333)
_M4 = np.uint64(0x0F0F0F0F0F0F0F0F)
_H = np.uint64(0x0101010101010101)
_S1, _S2, _S4, _S56 = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)


@inline_kernel
def popcount(x):  # type: ignore[no-untyped-def]
    """Set bits of a uint64, int64; LLVM makes one instruction of it where there is one."""
    x = x - ((x >> _S1) & _M1)
    x = (x & _M2) + ((x >> _S2) & _M2)
    x = (x + (x >> _S4)) & _M4
    return np.int64((x * _H) >> _S56)


@inline_kernel
def hamming(a, i, b, j):  # type: ignore[no-untyped-def]
    """Differing bits of row i of a (n, 4) uint64 and row j of b (m, 4) uint64: 0 to 256."""
    return (
        popcount(a[i, 0] ^ b[j, 0])
        + popcount(a[i, 1] ^ b[j, 1])
        + popcount(a[i, 2] ^ b[j, 2])
        + popcount(a[i, 3] ^ b[j, 3])
    )


@kernel
def quantise(descriptors, nodes, first_child, n_children, word, out):  # type: ignore[no-untyped-def]
    """Write the word of each descriptor: down the tree to the nearest child, to a leaf.

    descriptors  (n, 4)  uint64
    nodes        (m, 4)  uint64  centres; row 0 is the root
    first_child  (m,)    int32   children are consecutive rows, always behind their parent
    n_children   (m,)    uint8   0 at a leaf
    word         (m,)    int32   of a leaf
    out          (n,)    int32, out
    """
    for i in range(descriptors.shape[0]):
        node = 0
        while n_children[node] > 0:
            best = 257
            child = first_child[node]
            end = child + n_children[node]
            node = child
            while child < end:
                distance = hamming(descriptors, i, nodes, child)
                if distance < best:
                    best = distance
                    node = child
                child += 1
        out[i] = word[node]
