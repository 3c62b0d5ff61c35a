# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.geometry import se3, so3
from edge.odometry.room_axes import planes, turned
from edge.types import F64, Mat4

FOCAL_PX = 210.0
# How the camera goes and turns from the first of five frames; the third is the reference.
MOTION = np.array([0.05, 0.01, 0.03, 0.01, -0.03, 0.006])
PLACE = 2


def room(rng: np.random.Generator, along: F64) -> F64:
    """Ends (k, 2, 3) in the first camera of edges with these directions (k, 3)."""
    middle = rng.uniform((-1.2, -0.9, 2.5), (1.2, 0.9, 4.0), (len(along), 3))
    half = rng.uniform(0.3, 0.6, (len(along), 1)) * along
    return np.stack((middle - half, middle + half), axis=1)


def seen(T: Mat4, edges: F64, noise_px: F64 | float) -> F64:
    at = se3.transform(T, edges.reshape(-1, 3))
    return (at[:, :2] / at[:, 2:]).reshape(-1, 4) + noise_px / FOCAL_PX


def frames() -> list[Mat4]:
    rng = np.random.default_rng(1)
    return [se3.exp(k * MOTION + 0.004 * rng.normal(size=6)) for k in range(5)]


def test_the_turn_of_the_camera_is_known_whatever_its_way() -> None:
    rng = np.random.default_rng(2)
    axes = so3.exp(np.array([0.2, 0.5, -0.1]))
    along = np.concatenate((np.repeat(axes.T, (5, 6, 3), axis=0), rng.normal(size=(3, 3))))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    edges, T = room(rng, along), frames()
    views = [planes(seen(t, edges, rng.normal(0.0, 0.03, (len(along), 4))), FOCAL_PX) for t in T]
    views[4].normal[3] = np.nan  # not seen there
    reference = views.pop(PLACE)
    found = turned(reference, views, PLACE, FOCAL_PX)

    others = [t for k, t in enumerate(T) if k != PLACE]
    assert found.R.shape == (4, 3, 3)
    for R, t in zip(found.R, others, strict=True):
        assert so3.angle(R.T @ t[:3, :3] @ T[PLACE][:3, :3].T) < 0.012
    # Edges that run along no axis are left out.
    assert 13 <= len(found.along) <= 16
    true = T[PLACE][:3, :3] @ axes
    assert np.abs(found.along @ true).max(axis=1).min() > np.cos(0.02)
    # What is known of directions fits the planes they are seen in.
    off = np.einsum("mki,mij,kj->mk", found.normal, found.R, found.along) * FOCAL_PX
    assert np.median(np.abs(off)) < 0.3


def test_edges_that_run_anyhow_have_no_axes() -> None:
    rng = np.random.default_rng(3)
    along = rng.normal(size=(16, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    edges, T = room(rng, along), frames()
    views = [planes(seen(t, edges, 0.0), FOCAL_PX) for t in T]
    found = turned(views[0], views[1:], 0, FOCAL_PX)
    assert len(found.along) == len(found.R) == 0
    assert found.normal.shape == (4, 0, 3)
