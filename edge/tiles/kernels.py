# SPDX-License-Identifier: Apache-2.0
"""Scoring of an inverted index."""

import numpy as np

from edge.kernel import kernel

_ONE = np.uint64(1)  # unsigned indices need no test for wrapping around


@kernel
def add_common_weight(words, weights, offsets, keyframe, weight, n_keyframes, out):  # type: ignore[no-untyped-def]
    """Add to `out` what each keyframe's histogram has in common with the query's.

    words     (n,)     int32    words of the query
    weights   (n,)     float32  their weights, of sum 1
    offsets   (w + 1,) uint32   rows of the postings of each word
    keyframe  (b,)     uint16   postings: the keyframe that holds the word
    weight    (b,)     float32  and the word's weight in it
    out       (n_keyframes,) float32, out, added to

    Nothing is trusted: a word, row or keyframe out of range is left out.
    """
    end = np.uint64(keyframe.shape[0])
    for i in range(words.shape[0]):
        if words[i] < 0 or words[i] >= offsets.shape[0] - 1:
            continue
        word = np.uint64(words[i])
        asked = weights[i]
        row = np.uint64(offsets[word])
        stop = min(np.uint64(offsets[word + _ONE]), end)
        while row < stop:
            if keyframe[row] < n_keyframes:
                out[keyframe[row]] += min(asked, weight[row])
            row += _ONE
