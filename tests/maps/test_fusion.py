# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.types import F64
from maps.fusion import Points, fuse
from maps.settings import BuildSettings
from maps.tracks import Tracks
from tests.maps.point_world import EXACT, PINHOLE, World


def normalised_squares(points: Points, truth: F64) -> F64:
    """Squared Mahalanobis length (n,) of each error: chi-square of three degrees of freedom."""
    off = points.xyz - truth
    squares: F64 = np.einsum("ni,nij,nj->n", off, np.linalg.inv(points.covariance), off)
    return squares


@pytest.mark.parametrize("n_views", [2, 3, 8])
def test_points_without_noise_are_exact(n_views: int) -> None:
    world = World(n_views=n_views)
    points = world.fused()
    assert len(points.xyz) == len(world.xyz)
    assert np.abs(points.xyz - world.xyz).max() < 1e-4  # pixels are float32
    assert points.residual_px.max() < 1e-3
    assert np.array_equal(np.diff(points.offsets), np.full(len(world.xyz), n_views))


def test_parallax_is_the_widest_angle_between_rays() -> None:
    world = World(20, 4)
    towards = world.xyz - np.array([pose[:3, 3] for pose in world.poses])[:, None]
    towards /= np.linalg.norm(towards, axis=2, keepdims=True)
    cosines = np.einsum("ani,bni->abn", towards, towards).min(axis=(0, 1))
    assert world.fused().parallax_rad == pytest.approx(np.arccos(cosines), abs=1e-6)


@pytest.mark.parametrize(("n_views", "baseline"), [(2, 0.3), (4, 0.3), (8, 0.1), (5, 0.02)])
def test_covariances_are_honest(n_views: int, baseline: float) -> None:
    settings = BuildSettings(pose_error=0.0, sigma_px=0.7, gate_chi2=30.0)
    world = World(1500, n_views, baseline=baseline, noise_px=0.7, seed=1)
    points = world.fused(settings)
    assert len(points.xyz) > 1400
    order = points.feature[points.offsets[:-1]]
    squares = normalised_squares(points, world.xyz[order])
    # Mean 3; the median of the distribution is 2.37, its 95th percentile 7.81.
    assert np.median(squares) == pytest.approx(2.37, rel=0.15)
    assert np.mean(squares < 7.81) == pytest.approx(0.95, abs=0.025)


def test_a_point_of_little_parallax_is_kept_and_says_how_uncertain_it_is() -> None:
    near = World(200, 2, baseline=0.5, noise_px=0.5).fused(BuildSettings(sigma_px=0.5))
    far = World(200, 2, baseline=0.06, noise_px=0.5).fused(BuildSettings(sigma_px=0.5))
    assert np.rad2deg(np.median(far.parallax_rad)) < 1.5
    assert len(far.xyz) > 190
    deviation = [np.sqrt(np.linalg.eigvalsh(p.covariance)[:, 2]) for p in (near, far)]
    assert np.median(deviation[1]) > 6.0 * np.median(deviation[0])


def test_a_point_of_no_parallax_is_left_out() -> None:
    assert len(World(50, 3, baseline=0.0, noise_px=0.3).fused().xyz) < 5


def test_accuracy_is_learnt_from_residuals() -> None:
    world = World(3000, 6, noise_px=0.4, octaves=8, seed=2)
    accuracy = world.fused().accuracy
    assert accuracy.corner_px == pytest.approx(0.4, rel=0.15)
    assert accuracy.pose_px < 0.15


def test_errors_of_the_poses_are_told_from_those_of_corners() -> None:
    world = World(3000, 8, noise_px=0.3, octaves=8, seed=3)
    rng = np.random.default_rng(5)
    # A millimetre and a milliradian each way are half a pixel at 4 m and 500 px.
    world.poses = [se3.exp(rng.normal(0.0, [1e-3] * 3 + [1e-3] * 3)) @ pose for pose in world.poses]
    accuracy = world.fused().accuracy
    assert accuracy.corner_px == pytest.approx(0.35, rel=0.25)  # some of the poses' goes there
    assert 0.1 < accuracy.pose_px < 1.0


def test_a_wrong_observation_is_left_out_and_the_point_kept() -> None:
    world = World(100, 5, noise_px=0.3)
    for side in world.sides[2:3]:
        side.pixels[::2] += np.float32(25.0)
        side.rays[::2, 0] += 25.0 / PINHOLE.fx
        side.rays[::2, 1] += 25.0 / PINHOLE.fy
    points = world.fused()
    assert len(points.xyz) == 100
    assert np.abs(points.xyz - world.xyz).max() < 0.1
    owner = np.repeat(np.arange(100), np.diff(points.offsets))
    assert not np.any((points.view == 2) & (owner % 2 == 0))
    assert np.count_nonzero(points.view == 2) >= 48


def test_a_track_of_two_views_that_disagree_is_no_point() -> None:
    world = World(60, 2)
    world.sides[1].pixels[:, 1] += np.float32(40.0)
    world.sides[1].rays[:, 1] += 40.0 / PINHOLE.fy
    assert len(world.fused().xyz) == 0


def test_what_lies_behind_a_camera_is_no_point() -> None:
    world = World(60, 2, baseline=0.4)
    world.poses.reverse()  # rays now meet behind
    assert len(world.fused().xyz) == 0


def test_one_view_with_a_depth_makes_a_point() -> None:
    world = World(2000, 1, noise_px=0.5, depth_sigma=0.01, seed=4)
    points = world.fused(BuildSettings(pose_error=0.0, sigma_px=0.5))
    assert len(points.xyz) == 2000
    assert points.parallax_rad.max() == 0.0
    squares = normalised_squares(points, world.xyz)
    assert np.median(squares) == pytest.approx(2.37, rel=0.15)
    along = np.sqrt(points.covariance[:, 2, 2])
    assert np.median(along) == pytest.approx(0.01, rel=0.05)


def test_depths_and_views_together_are_better_than_either() -> None:
    def spread(**world: float) -> float:
        points = World(300, noise_px=0.5, seed=6, **world).fused(  # type: ignore[arg-type]
            BuildSettings(pose_error=0.0, sigma_px=0.5)
        )
        return float(np.median(np.sqrt(points.covariance[:, 2, 2])))

    views = spread(n_views=3, baseline=0.05)
    depth = spread(n_views=1, depth_sigma=0.05)
    both = spread(n_views=3, baseline=0.05, depth_sigma=0.05)
    assert both < 0.75 * min(views, depth)


def test_errors_that_views_share_do_not_average_out() -> None:
    points = World(100, 8).fused(BuildSettings(pose_error=0.01))
    least = np.sqrt(np.linalg.eigvalsh(points.covariance)[:, 0])
    assert least.min() > 0.01 * 2.5  # a hundredth of three metres and more


def test_errors_of_the_poses_do_not_average_out() -> None:
    rng = np.random.default_rng(7)
    least = []
    for n_views in (8, 24):
        world = World(1000, n_views, baseline=1.2 / n_views, noise_px=0.3, octaves=8, seed=7)
        world.poses = [se3.exp(rng.normal(0.0, 1e-3, 6)) @ pose for pose in world.poses]
        points = world.fused()
        assert points.accuracy.pose_px > 0.1
        sideways = np.sqrt(np.linalg.eigvalsh(points.covariance)[:, 0])
        least.append(np.median(sideways) / points.accuracy.pose_px)
    assert least[1] > 0.75 * least[0]


def test_no_tracks_give_no_points() -> None:
    empty = np.empty(0, np.int32)
    world = World(5, 2)
    points = fuse(Tracks(np.array([0]), empty, empty), world.poses, world.sides, EXACT)
    assert points.xyz.shape == (0, 3)
