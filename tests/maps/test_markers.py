# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.errors import ConfigError
from edge.geometry import se3
from edge.markers.edges import refine_corners
from edge.markers.finder import MarkerFinder, families
from edge.types import F64
from maps.markers import Sighting, sides, squares
from tests.maps import posters
from tests.maps.posters import CAMERA, MARKER_NUMBER, MARKER_SIDE_M, path, picture


def true_corners(T_world_cam: F64) -> F64:
    """Raw pixels (4, 2) of the marker's corners."""
    hung = posters.posters()[3]
    border = 0.25 * MARKER_SIDE_M
    low = np.array([hung.x + border, hung.y + border, hung.z])
    steps = MARKER_SIDE_M * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    return CAMERA.project(se3.transform(se3.inverse(T_world_cam), low + steps))


def test_corners_lie_where_they_are_without_a_pull_inwards() -> None:
    finder = MarkerFinder("4x4_50")
    errors = []
    for T in path(6):
        (marker,) = finder.find(picture(posters.posters(), T)[0])
        assert marker.number == MARKER_NUMBER
        truth = true_corners(T)
        errors.append(marker.corners - truth)
        assert sides_px(marker.corners) == pytest.approx(sides_px(truth), rel=0.01)
    assert np.sqrt(np.mean(np.square(errors))) < 0.3  # px
    inwards = np.sign(truth.mean(axis=0) - truth)
    assert abs(np.mean(np.array(errors) * inwards)) < 0.05


def sides_px(corners: F64) -> float:
    return float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())


def test_corners_without_edges_are_left_as_they_are() -> None:
    flat = np.full((240, 320), 90, np.uint8)
    corners = np.array([[100.0, 100], [160, 100], [160, 160], [100, 160]])
    np.testing.assert_array_equal(refine_corners(flat, corners, 6), corners)
    tiny = corners / 20.0
    np.testing.assert_array_equal(refine_corners(flat, tiny, 6), tiny)


def test_a_number_that_occurs_twice_in_an_image_is_left_out() -> None:
    image, _ = picture(posters.posters(), path(3)[1])
    assert MarkerFinder("4X4_50").find(np.vstack([image, image])) == []


def test_an_unknown_family_is_refused_with_those_that_are_known() -> None:
    assert "APRILTAG_36H11" in families()
    MarkerFinder("DICT_APRILTAG_36h11")
    with pytest.raises(ConfigError, match=r"9X9_9.*4X4_50"):
        MarkerFinder("9X9_9")


def test_squares_are_where_rays_meet_and_need_two_sides() -> None:
    corners = np.array([[0.0, 0, 2], [0.3, 0, 2], [0.3, 0.3, 2], [0, 0.3, 2]])
    seen = []
    for x in (-0.5, 0.0, 0.6):
        T = se3.exp([x, 0.1, 0, 0.05, -0.2 * x, 0.1])
        local = se3.transform(se3.inverse(T), corners)
        seen.append(Sighting(T, 4, local[:, :2] / local[:, 2:]))
    ((number, square),) = squares(seen)
    assert number == 4
    np.testing.assert_allclose(square, corners, atol=1e-9)
    np.testing.assert_allclose(sides(square), 0.3, atol=1e-9)
    assert list(squares(seen[:1])) == []
    assert list(squares([seen[0], seen[0]])) == []
