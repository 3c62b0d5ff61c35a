# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.learned.codes import BITS, encode, planes


def bits(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.unpackbits(a ^ b, axis=1).sum(axis=1)


@pytest.mark.parametrize("dimensions", [16, 64, 96, 256, 512])
def test_the_share_of_bits_that_differ_is_the_angle(dimensions: int) -> None:
    rng = np.random.default_rng(dimensions)
    origin = rng.normal(size=dimensions).astype(np.float32)
    first, other = rng.normal(size=(2, 400, dimensions))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    other -= np.sum(other * first, axis=1, keepdims=True) * first
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    normals = planes(dimensions)
    for angle in (0.2, 0.8, 1.57):
        second = np.cos(angle) * first + np.sin(angle) * other
        a, b = (encode((v + origin).astype(np.float32), origin, normals) for v in (first, second))
        assert a.shape == (400, BITS // 8)
        # One code scatters by 8 bits at most; their mean by a twentieth of that.
        assert bits(a, b).mean() == pytest.approx(BITS * angle / np.pi, abs=4.0)


def test_planes_are_at_right_angles_as_far_as_dimensions_go() -> None:
    normals = planes(64).astype(np.float64)
    for block in normals.reshape(4, 64, 64):
        np.testing.assert_allclose(block @ block.T, np.eye(64), atol=1e-5)
    assert np.abs(normals[:64] @ normals[64:].T).max() < 0.9
