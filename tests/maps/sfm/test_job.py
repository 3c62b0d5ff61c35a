# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.geometry.camera import CameraModel
from maps.sfm.job import Job, Photo, from_colmap, may_refine, read, to_colmap, with_k1, write

SQUARE = CameraModel(320, 240, 260.0, 260.0, 161.0, 118.5)
OBLONG = CameraModel(320, 240, 260.0, 270.0, 161.0, 118.5)
BENT = CameraModel(320, 240, 260.0, 270.0, 161.0, 118.5, "radtan", (-0.2, 0.03, 0.001, -0.002))
FISH = CameraModel(320, 240, 160.0, 170.0, 161.0, 118.5, "equidistant", (0.01, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("camera", [SQUARE, OBLONG, BENT, FISH])
def test_pixels_for_colmap_are_those_of_one_focal_length_and_come_back(camera: CameraModel) -> None:
    raw = np.random.default_rng(0).uniform((0, 0), (319, 239), (50, 2)).astype(np.float32)
    pixels = to_colmap(camera, raw)
    ideal = camera.undistort(camera.normalise(raw))
    np.testing.assert_allclose(
        (pixels - 0.5 - (camera.cx, camera.cy)) / camera.fx, ideal, atol=1e-9
    )
    np.testing.assert_allclose(from_colmap(camera, pixels - 0.5), raw, atol=1e-6)


def test_a_job_comes_back_from_its_file(tmp_path: Path) -> None:
    job = Job(
        photos=[Photo("/some where", 3, 1)],
        cameras=[SQUARE, BENT],
        pairs=[(0, 1)],
        refine_lens=True,
        threads=2,
    )
    write(job, tmp_path)
    assert read(tmp_path) == job
    assert may_refine(job, 0)
    assert not may_refine(job, 1)


def test_a_coefficient_counts_where_it_moves_the_corners() -> None:
    assert with_k1(SQUARE, 0.0) is SQUARE
    assert with_k1(SQUARE, 0.002) is SQUARE  # 0.23 px in the corners
    assert with_k1(SQUARE, -0.003).distortion == (-0.003, 0.0, 0.0, 0.0)
