# SPDX-License-Identifier: Apache-2.0
import math

import cv2
import numpy as np
import pytest

from edge.geometry import distortion

EUROC = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
KINECT = (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
RATIONAL = (0.4, 0.1, 0.001, -0.0005, 0.01, 0.7, 0.15, 0.02)
FISHEYE = (-0.01, 0.02, -0.015, 0.003)
FOLDING = (-0.3, 0.0, 0.001, 0.0005)  # r - 0.3 r^3 turns back at r = 1.054
LENSES = [
    ("none", (), 2.0),
    ("radtan", EUROC, 1.3),
    ("radtan", KINECT, 1.5),  # its radius swings: Newton alone fails there
    ("radtan", RATIONAL, 1.0),
    ("radtan", FOLDING, 0.95),
    ("equidistant", FISHEYE, 4.0),
    ("equidistant", (0.0, 0.0, 0.0, 0.0), 10.0),
]
IDS = ["none", "euroc", "kinect", "rational", "folding", "fisheye", "ideal-fisheye"]
every_lens = pytest.mark.parametrize(("model", "k", "reach"), LENSES, ids=IDS)


def disc(radius: float, n: int = 400) -> np.ndarray:
    """Points of all radii and directions, the axis and its neighbourhood included."""
    rng = np.random.default_rng(0)
    r, angle = np.r_[0.0, 1e-9, 1e-4, rng.uniform(0.0, radius, n)], rng.uniform(0.0, 7.0, n + 3)
    return np.column_stack((r * np.cos(angle), r * np.sin(angle)))


@every_lens
def test_undistort_gives_back_what_distort_took(
    model: str, k: tuple[float, ...], reach: float
) -> None:
    ideal = disc(reach)
    back = distortion.undistort(model, k, distortion.distort(model, k, ideal))

    # At grazing angles a fisheye squeezes the plane, and the inverse magnifies rounding.
    assert back == pytest.approx(ideal, abs=1e-10 * (1.0 + reach**2))


@every_lens
def test_jacobian_is_the_slope_of_distort(model: str, k: tuple[float, ...], reach: float) -> None:
    points = disc(reach)
    for axis in range(2):
        step = np.eye(2)[axis] * 1e-6
        rise = distortion.distort(model, k, points + step)
        rise -= distortion.distort(model, k, points - step)
        slope = distortion.jacobian(model, k, points)[:, :, axis]

        assert slope == pytest.approx(rise / 2e-6, abs=1e-7)


@pytest.mark.parametrize("k", [EUROC, KINECT, RATIONAL, FOLDING])
def test_radtan_is_opencvs(k: tuple[float, ...]) -> None:
    points = disc(0.9)
    rays = np.column_stack((points, np.ones(len(points))))
    theirs, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(k))

    assert distortion.distort("radtan", k, points) == pytest.approx(theirs[:, 0], abs=1e-13)


def test_equidistant_is_opencvs_fisheye() -> None:
    points = disc(4.0)
    theirs = cv2.fisheye.distortPoints(points[:, None], np.eye(3), np.array(FISHEYE))[:, 0]

    assert distortion.distort("equidistant", FISHEYE, points) == pytest.approx(theirs, abs=1e-12)


def test_undistort_is_opencvs_where_that_converges() -> None:
    points = disc(0.4)  # its default of five fixed-point steps reaches 1e-6 this near the axis
    theirs = cv2.undistortPoints(points[:, None], np.eye(3), np.array(EUROC))[:, 0]

    assert distortion.undistort("radtan", EUROC, points) == pytest.approx(theirs, abs=1e-5)


def test_undistort_is_opencvs_fisheye() -> None:
    points = disc(1.2)
    theirs = cv2.fisheye.undistortPoints(points[:, None], np.eye(3), np.array(FISHEYE))[:, 0]

    ours = distortion.undistort("equidistant", FISHEYE, points)
    assert ours == pytest.approx(theirs, rel=1e-6, abs=1e-9)


def test_a_folding_lens_has_its_limit_where_the_radius_turns_back() -> None:
    assert distortion.field_limit("radtan", FOLDING) == pytest.approx(math.sqrt(1.0 / 0.9))


@pytest.mark.parametrize("model", ["none", "radtan", "equidistant"])
def test_a_lens_that_never_folds_is_limited_by_the_angle_alone(model: str) -> None:
    k = {"none": (), "radtan": EUROC, "equidistant": (0.0, 0.0, 0.0, 0.0)}[model]

    assert distortion.field_limit(model, k) == pytest.approx(math.tan(math.radians(89.0)))


def test_a_fisheye_is_limited_where_its_polynomial_turns_back() -> None:
    limit = math.atan(distortion.field_limit("equidistant", (-0.2, 0.0, 0.0, 0.0)))

    assert limit == pytest.approx(math.sqrt(1.0 / 0.6))  # 1 + 3 k1 theta^2 = 0


def test_a_pole_of_the_rational_model_limits_it() -> None:
    k = (0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0)  # 1 / (1 - 0.25 r^2)

    assert distortion.field_limit("radtan", k) == pytest.approx(2.0)


def test_a_rational_lens_is_limited_where_its_denominator_wins() -> None:
    k = (0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0)  # r / (1 + 0.5 r^2)

    assert distortion.field_limit("radtan", k) == pytest.approx(math.sqrt(2.0))


def test_grazing_rays_of_a_fisheye_have_an_inverse() -> None:
    angles = np.radians([85.0, 88.0, 88.9])
    distorted = np.column_stack((angles, 0.0 * angles))
    ideal = distortion.undistort("equidistant", (0.0, 0.0, 0.0, 0.0), distorted)

    assert ideal[:, 0] == pytest.approx(np.tan(angles), rel=1e-8)


def test_nothing_beyond_the_fold_is_given_as_an_inverse() -> None:
    limit = distortion.field_limit("radtan", FOLDING)
    distorted = disc(4.0, 4000)
    ideal = distortion.undistort("radtan", FOLDING, distorted)
    found = np.isfinite(ideal).all(axis=1)

    assert (np.hypot(*ideal[found].T) <= limit).all()
    assert not found[np.hypot(*distorted.T) > 0.72].any()
    assert found[np.hypot(*distorted.T) < 0.69].all()


def test_points_that_no_ray_reaches_have_no_inverse() -> None:
    # The largest radius that r - 0.3 r^3 takes is 0.703.
    distorted = np.array([[0.6, 0.0], [0.75, 0.0], [0.0, -3.0], [50.0, 50.0]])
    ideal = distortion.undistort("radtan", FOLDING, distorted)

    assert np.isfinite(ideal[0]).all()
    assert np.isnan(ideal[1:]).all()


def test_no_points_are_no_trouble() -> None:
    assert distortion.undistort("radtan", EUROC, np.empty((0, 2))).shape == (0, 2)
