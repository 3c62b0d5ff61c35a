# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.geometry import se3
from edge.lines.line import (
    across,
    ends,
    lines_between,
    moved,
    plane_normals,
    segments_between,
)
from tests.edge.lines.line_scenes import CAMERA, ends_before, observed, viewpoint


def test_segments_keep_their_ends() -> None:
    given = np.random.default_rng(1).uniform(0.0, 600.0, (7, 4))
    np.testing.assert_allclose(ends(segments_between(given, 1.0)), given)


def test_the_plane_through_the_centre_holds_the_line() -> None:
    rng = np.random.default_rng(2)
    T = viewpoint(rng)
    pair = ends_before(rng, T, 12, flat=False)
    _, segments = observed(rng, T, pair, 1e-12, 1e-12)
    normals = plane_normals(segments, CAMERA)
    for k in range(2):
        points = se3.transform(T, pair[:, k])
        np.testing.assert_allclose(np.sum(normals * points, axis=1), 0.0, atol=1e-9)


def test_steps_across_a_line_keep_its_frame_orthonormal() -> None:
    rng = np.random.default_rng(3)
    first = rng.normal(size=(9, 3))
    lines = lines_between(first, first + rng.normal(size=(9, 3)), 0.01)
    step = rng.normal(0.0, 0.3, (9, 4))
    after = moved(lines, step)
    frame = np.concatenate((after.direction[:, None], across(after.direction)), axis=1)
    np.testing.assert_allclose(
        frame @ frame.transpose(0, 2, 1), np.eye(3)[None] + 0 * frame, atol=1e-12
    )
    shift = np.einsum("nki,ni->nk", across(lines.direction), after.point - lines.point)
    np.testing.assert_allclose(shift, step[:, :2], atol=1e-12)


def test_the_covariance_of_a_line_is_that_of_its_ends() -> None:
    rng = np.random.default_rng(4)
    first, last, sigma = np.array([[0.0, 0, 2]]), np.array([[0.5, 0, 2]]), 0.01
    lines = lines_between(first, last, sigma)
    many = lines_between(*(end + rng.normal(0, sigma, (20000, 3)) for end in (first, last)), sigma)
    basis = across(lines.direction)[0]
    errors = np.hstack(((many.point - lines.point) @ basis.T, many.direction @ basis.T))
    np.testing.assert_allclose(
        np.std(errors, axis=0), np.sqrt(np.diag(lines.covariance[0])), rtol=0.03
    )
