# SPDX-License-Identifier: Apache-2.0
"""The two steps of k-majority: nearest centre, and the majority of each bit."""

from edge.kernel import kernel
from edge.relocalise.kernels_bow import hamming


@kernel
def assign(descriptors, rows, centres, labels, distances):  # type: ignore[no-untyped-def]
    """Overwrite labels and distances with each descriptor's nearest centre.

    descriptors  (n, 4)  uint64
    rows         (m,)    int64   which of them take part
    centres      (k, 4)  uint64
    labels       (m,)    int32, out; of equal distances the lower centre
    distances    (m,)    int32, out; bits
    """
    for i in range(rows.shape[0]):
        best, label = 257, 0
        for c in range(centres.shape[0]):
            distance = hamming(descriptors, rows[i], centres, c)
            if distance < best:
                best, label = distance, c
        labels[i] = label
        distances[i] = best


@kernel
def count_bits(descriptors, rows, labels, ones, members):  # type: ignore[no-untyped-def]
    """Add up, for each centre, its members and how many of them have each bit set.

    descriptors  (n, 32)     uint8
    rows, labels (m,)        as `assign` left them
    ones         (k, 256)    int64, out, added to; bit 0 of byte 0 first
    members      (k,)        int64, out, added to
    """
    for i in range(rows.shape[0]):
        label = labels[i]
        members[label] += 1
        for byte in range(32):
            value = descriptors[rows[i], byte]
            for bit in range(8):
                ones[label, byte * 8 + bit] += (value >> bit) & 1
