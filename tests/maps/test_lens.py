# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.relocalise.features import Features
from edge.tiles.manifest import camera_entry, encode
from edge.tiles.reader import open_map
from edge.types import DepthSamples
from maps.describe import Description
from maps.lens import described_through, refined
from maps.lens_fit import SIZE, Sightings, fit, lens_with, slopes
from tests.maps.small_map import write_small_map

GIVEN = CameraModel(640, 480, 525.0, 525.0, 320.0, 240.0)
BENT = CameraModel(
    640, 480, 525.0, 525.0, 320.0, 240.0, distortion_model="radtan", distortion=(-0.03, 0, 0, 0)
)


def sightings_through(
    camera: CameraModel, n_points: int = 500, noise_px: float = 0.5, pose_noise: float = 0.0
) -> Sightings:
    """A walk of 24 views past a wall of points, seen through `camera`."""
    rng = np.random.default_rng(7)
    xyz = rng.uniform((-3.0, -1.5, 2.5), (3.0, 1.5, 4.0), (n_points, 3))
    T_map_cam = [
        se3.exp(np.array((x, 0.1 * np.sin(x), 0.0, 0.02 * x, 0.1 * x, 0.0)))
        for x in np.linspace(-1.2, 1.2, 24)
    ]
    T_cam_map = np.array([se3.inverse(T) for T in T_map_cam])
    raw = np.array([camera.project(xyz @ T[:3, :3].T + T[:3, 3]) for T in T_cam_map])
    raw += rng.normal(0.0, noise_px, raw.shape)
    inside = (raw >= 0.0).all(axis=2) & (raw[..., 0] < 639.0) & (raw[..., 1] < 479.0)
    inside &= rng.uniform(size=inside.shape) < 0.5
    for view, T in enumerate(T_cam_map):
        T_cam_map[view] = se3.exp(rng.normal(0.0, pose_noise, 6)) @ T
    point, view = np.nonzero(inside.T)
    counts = np.bincount(point, minlength=n_points)
    offsets = np.concatenate(([0], np.cumsum(counts)))
    sigma = np.full(len(point), noise_px)
    rough = xyz + rng.normal(0.0, 0.01, xyz.shape)
    whole = Sightings(offsets, view.astype(np.int32), raw[view, point], sigma, rough, T_cam_map)
    return whole.some(np.flatnonzero(counts >= 3))


def test_a_lens_that_the_calibration_lacks_is_found() -> None:
    lens = refined(sightings_through(BENT), GIVEN)
    assert lens is not None
    assert lens.camera.distortion[0] == pytest.approx(-0.03, abs=0.004)
    assert lens.camera.fx == GIVEN.fx  # what bends little is left as it was
    assert lens.gain > 0.1


def test_a_wrong_focal_length_is_found() -> None:
    true = lens_with(GIVEN, np.array((0.0, 0.0, 0.02, 0.0, 0.0)))
    lens = refined(sightings_through(true), GIVEN)
    assert lens is not None
    assert lens.camera.fx == pytest.approx(true.fx, rel=0.006)


@pytest.mark.parametrize("pose_noise", [0.0, 0.002])
def test_a_right_calibration_stays(pose_noise: float) -> None:
    assert refined(sightings_through(GIVEN, pose_noise=pose_noise), GIVEN) is None
    assert refined(sightings_through(BENT, pose_noise=pose_noise), BENT) is None


def test_few_points_change_nothing() -> None:
    assert refined(sightings_through(BENT, n_points=150), GIVEN) is None


def test_points_in_the_middle_of_the_image_do_not_tell_of_its_corners() -> None:
    every = sightings_through(BENT, n_points=1500)
    near = np.hypot(*(every.raw - (320.0, 240.0)).T) < 110.0
    owner = np.repeat(np.arange(len(every.xyz)), np.diff(every.offsets))[near]
    counts = np.bincount(owner, minlength=len(every.xyz))
    inner = every._replace(
        offsets=np.concatenate(([0], np.cumsum(counts))),
        view=every.view[near],
        raw=every.raw[near],
        sigma=every.sigma[near],
    ).some(np.flatnonzero(counts >= 3))
    assert len(inner.xyz) > 240
    assert refined(inner, GIVEN) is None


def test_a_fit_without_free_parameters_leaves_the_lens() -> None:
    s = sightings_through(GIVEN)
    held = fit(s, GIVEN, np.zeros(SIZE), 0)
    assert not held.theta.any()
    # The mean robust cost of right sightings, less what the points themselves took up.
    assert held.cost / len(s.view) == pytest.approx(1.3, abs=0.3)


def test_slopes_agree_with_differences() -> None:
    ideal = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    theta = np.array((0.01, -0.02, 0.003, 1.0, -2.0))
    for camera in (GIVEN, BENT):
        J = slopes(camera, theta, ideal, SIZE)
        for k, h in enumerate((1e-4, 1e-4, 1e-5, 1e-2, 1e-2)):
            step = h * np.eye(SIZE)[k]
            ends = [lens_with(camera, theta + s) for s in (step, -step)]
            a, b = (end.denormalise(end.distort(ideal)) for end in ends)
            np.testing.assert_allclose(J[:, :, k], (a - b) / (2.0 * h), rtol=2e-3, atol=2e-2)


def test_descriptions_are_read_through_the_new_lens() -> None:
    rng = np.random.default_rng(1)
    raw = rng.uniform((5.0, 5.0), (634.0, 474.0), (40, 2)).astype(np.float32)
    n = len(raw)
    features = Features(
        raw, np.zeros((n, 32), np.uint8), np.zeros(n, np.uint8), np.zeros(n, np.float32), raw
    )
    samples = DepthSamples(raw, np.ones(n, np.float32), np.ones(n, np.float32))
    old = Description(features, None, np.ones(n), np.ones(n), samples)  # type: ignore[arg-type]
    new = described_through(old, GIVEN, BENT)
    expected = BENT.undistort_pixels(raw.astype(np.float64))
    np.testing.assert_allclose(new.features.pixels, expected, atol=1e-3)
    np.testing.assert_allclose(new.samples.pixels, expected, atol=1e-3)
    np.testing.assert_array_equal(new.features.raw_pixels, raw)


def test_a_map_reads_images_of_a_replaced_calibration_by_the_refined_one(tmp_path: Path) -> None:
    folder = write_small_map(tmp_path / "small").folder
    old = open_map(folder)
    given = camera_entry(GIVEN)
    entry = msgspec.structs.replace(camera_entry(BENT), replaces=given.id)
    assert entry.id == camera_entry(BENT).id
    manifest = msgspec.structs.replace(old.manifest, cameras=[entry])
    (folder / "manifest.json").write_bytes(encode(manifest))
    new = open_map(folder)
    assert new.camera_for(GIVEN) == BENT
    assert new.camera_for(BENT) == BENT
    other = lens_with(GIVEN, np.array((0.0, 0.0, 0.1, 0.0, 0.0)))
    assert new.camera_for(other) == other
