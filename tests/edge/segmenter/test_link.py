# SPDX-License-Identifier: Apache-2.0
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.segmenter.link import pack, unpack
from edge.types import Detections, Mask

SHAPE = (40, 70)


def detections(seed: int) -> Detections:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 5))
    masks = []
    for _ in range(n):
        w, h = (int(v) for v in rng.integers(1, (SHAPE[1], SHAPE[0])))
        left, top = int(rng.integers(0, SHAPE[1] - w + 1)), int(rng.integers(0, SHAPE[0] - h + 1))
        masks.append(Mask(left, top, rng.random((h, w)) < 0.5))
    return Detections(
        rng.random((n, 4)).astype(np.float32),
        rng.random(n).astype(np.float32),
        rng.integers(0, 80, n).astype(np.int32),
        tuple(masks),
    )


@given(st.integers(0, 10_000))
def test_detections_come_through_as_they_are(seed: int) -> None:
    sent = detections(seed)

    came = unpack(pack(1, sent, 2.0, 3.0), SHAPE)

    np.testing.assert_array_equal(came.boxes, sent.boxes)
    np.testing.assert_array_equal(came.scores, sent.scores)
    np.testing.assert_array_equal(came.classes, sent.classes)
    assert [m[:2] for m in came.masks] == [m[:2] for m in sent.masks]
    for a, b in zip(came.masks, sent.masks, strict=True):
        np.testing.assert_array_equal(a.inside, b.inside)


@pytest.mark.parametrize(
    "change",
    [
        {"boxes": b"123"},
        {"scores": b""},
        {"masks": []},
        {"boxes": np.full(4, np.nan, np.float32).tobytes()},
    ],
)
def test_spoiled_parts_are_noticed(change: dict[str, object]) -> None:
    one = Detections(
        np.ones((1, 4), np.float32),
        np.ones(1, np.float32),
        np.ones(1, np.int32),
        (Mask(60, 30, np.ones((10, 10), dtype=bool)),),
    )
    good = pack(1, one, 2.0, 3.0)
    unpack(good, SHAPE)

    with pytest.raises(ValueError, match=r"."):
        unpack(msgspec.structs.replace(good, **change), SHAPE)
    with pytest.raises(ValueError, match="does not fit"):
        unpack(good, (39, 70))
    with pytest.raises(ValueError, match="does not fit"):
        unpack(good, (40, 69))
