# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.lines import kernels_structure
from edge.lines.line import Lines, across, segments_between, take_segments
from edge.lines.structure import Views, triangulate
from edge.types import F64
from tests.edge.lines.line_scenes import CAMERA, ends_before, project, viewpoint


def along_a_path(rng: np.random.Generator, n_views: int, sideways_m: float) -> F64:
    """Poses T_cam_lines of a camera that moves to the side."""
    steps = np.linspace(0.0, sideways_m, n_views)
    T = viewpoint(rng)
    turns = rng.normal(0.0, 0.03, (n_views, 3))
    return np.array([se3.exp([s, 0.3 * s, 0, *w]) @ T for s, w in zip(steps, turns, strict=True)])


def views_of_lines(
    rng: np.random.Generator, poses: F64, pairs: F64, noise_px: float
) -> list[Views]:
    """Each line in each view, another part of it every time."""
    found = []
    for pair in pairs:
        parts = []
        for T in poses:
            share = np.array([rng.uniform(0.0, 0.2), rng.uniform(0.8, 1.0)])[:, None]
            pixels = project(se3.transform(T, pair[0] + share * (pair[1] - pair[0])))
            parts.append((pixels + rng.normal(0.0, noise_px, (2, 2))).ravel())
        found.append(Views(segments_between(np.array(parts), max(noise_px, 1e-6)), poses))
    return found


def errors_of(lines: Lines, pairs: F64) -> F64:
    """Errors (n, 4) along `across` at the lines' points: the truth less what was found."""
    basis = across(lines.direction)
    true = pairs[:, 1] - pairs[:, 0]
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    true *= np.sign(np.sum(true * lines.direction, axis=1))[:, None]
    cosine = np.sum(true * lines.direction, axis=1)[:, None]
    away = np.sum((lines.point - pairs[:, 0]) * lines.direction, axis=1)[:, None]
    on_truth = pairs[:, 0] + true / cosine * away
    shift = np.einsum("nki,ni->nk", basis, on_truth - lines.point)
    return np.hstack((shift, np.einsum("nki,ni->nk", basis, true / cosine)))


@pytest.mark.parametrize("n_views", [2, 5])
def test_ideal_views_give_the_exact_line_and_where_it_was_seen(n_views: int) -> None:
    rng = np.random.default_rng(1)
    poses = along_a_path(rng, n_views, 0.4)
    pairs = ends_before(rng, poses[0], 20, flat=False)
    found = triangulate(views_of_lines(rng, poses, pairs, 0.0), CAMERA)
    assert np.all(found.known)
    np.testing.assert_allclose(errors_of(found.lines, pairs), 0.0, atol=1e-5)
    length = np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=1)
    seen = (found.span[:, 1] - found.span[:, 0]) / length
    assert np.all((seen > 0.55) & (seen < 1.001))
    middle = found.lines.point + found.span.mean(axis=1)[:, None] * found.lines.direction
    assert np.all(np.linalg.norm(middle - pairs.mean(axis=1), axis=1) < 0.15 * length)


def test_covariance_is_honest() -> None:
    values = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        poses = along_a_path(rng, 6, 0.6)
        pairs = ends_before(rng, poses[0], 12, flat=False)
        found = triangulate(views_of_lines(rng, poses, pairs, 0.5), CAMERA, cauchy2=1e6)
        e, C = errors_of(found.lines, pairs), found.lines.covariance
        # Known, and where linear theory holds.
        sure = found.known & (np.linalg.eigvalsh(C)[:, -1] < 0.05**2)
        values += list(np.einsum("ni,nij,nj->n", e[sure], np.linalg.inv(C[sure]), e[sure]))
    assert len(values) > 100
    assert 3.0 < np.mean(values) < 5.2  # four degrees of freedom; these trials hold it to 0.25


def test_more_views_tell_more_and_a_wrong_one_little() -> None:
    rng = np.random.default_rng(7)
    poses = along_a_path(rng, 8, 0.6)
    pairs = ends_before(rng, poses[0], 12, flat=False)
    views = views_of_lines(rng, poses, pairs, 0.3)
    few = [Views(take_segments(v.segments, np.arange(8) < 3), v.T_cam_lines[:3]) for v in views]
    sizes = [np.linalg.det(triangulate(v, CAMERA).lines.covariance) for v in (few, views)]
    assert np.mean(sizes[1] < sizes[0]) > 0.8
    spoilt = []
    for view in views:
        middle = view.segments.middle.copy()
        middle[4] += [9.0, 9.0]
        spoilt.append(Views(view.segments._replace(middle=middle), view.T_cam_lines))
    error = np.abs(errors_of(triangulate(spoilt, CAMERA).lines, pairs))
    clean = np.abs(errors_of(triangulate(views, CAMERA).lines, pairs))
    assert np.median(error) < 3.0 * np.median(clean)


def test_a_line_in_the_plane_of_motion_is_not_known() -> None:
    poses = np.array([se3.exp([x, 0, 0, 0, 0, 0]) for x in (0.0, -0.2, -0.4)])
    pair = np.array([[[-0.5, 0.3, 2.0], [0.6, 0.3, 2.0]]])
    rng = np.random.default_rng(2)
    found = triangulate(views_of_lines(rng, poses, pair, 1e-7), CAMERA)
    assert not found.known[0]


def test_both_frames_across_a_line_are_the_same() -> None:
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(50, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    basis = np.empty((2, 3))
    for k, expected in enumerate(across(direction)):
        kernels_structure.frame_across(direction[k], basis)
        np.testing.assert_allclose(basis, expected, atol=1e-15)


def test_no_views_give_no_lines() -> None:
    found = triangulate([], CAMERA)
    assert found.lines.point.shape == (0, 3)
    assert found.span.shape == (0, 2)
    assert found.known.shape == (0,)
