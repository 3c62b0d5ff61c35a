# SPDX-License-Identifier: Apache-2.0
"""Scoring of an inverted index."""

from edge.kernel import kernel


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
    end = keyframe.shape[0]
    for i in range(words.shape[0]):
        word = words[i]
        if word < 0 or word >= offsets.shape[0] - 1:
            continue
        for j in range(min(offsets[word], end), min(offsets[word + 1], end)):
            if keyframe[j] < n_keyframes:
                out[keyframe[j]] += min(weights[i], weight[j])
