# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from edge.errors import RecordingError
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.runtime.board import Board
from edge.runtime.calibrate import Calibration, calibrate_camera
from edge.runtime.calibration_views import MAX_VIEWS, choose
from tests.edge.runtime.board_images import SPEC, board_poses, exact_views, render

SIZE = (640, 480)
RADTAN = CameraModel(
    *(*SIZE, 420.0, 421.0, 318.0, 242.0), "radtan", (-0.3, 0.11, 0.001, -0.0005, -0.02)
)
FISHEYE = CameraModel(
    *SIZE, 320.0, 321.0, 322.0, 236.0, "equidistant", (0.03, -0.02, 0.008, -0.002)
)


def _worst_px(found: Calibration, true: CameraModel) -> float:
    """Largest distance [px] between the two, over the parts of the image that the board was in."""
    pixels = np.concatenate([view.pixels for view in found.views])
    rays = true.normalise(true.undistort_pixels(pixels))
    again = found.camera.project(np.column_stack((rays, np.ones(len(rays)))))
    return float(np.linalg.norm(again - pixels, axis=1).max())


@pytest.mark.slow
@pytest.mark.parametrize("true", [RADTAN, FISHEYE], ids=["radtan", "equidistant"])
def test_the_lens_and_its_model_are_found(true: CameraModel) -> None:
    views = exact_views(true, board_poses(30, seed=1, reach=0.7), noise_px=0.15)
    found = calibrate_camera(views, len(views), *SIZE)
    assert found.camera.distortion_model == true.distortion_model
    assert found.result.rms_px == pytest.approx(0.15, rel=0.1)
    assert found.held_out_px == pytest.approx(0.15, rel=0.2)
    assert _worst_px(found, true) < 0.6
    assert abs(found.camera.fx - true.fx) < 4 * found.result.sigma[0]


@pytest.mark.slow
def test_a_rendered_board_is_found_to_a_tenth_of_a_pixel() -> None:
    board = Board(SPEC)
    views = []
    for number, T in enumerate(board_poses(18, seed=2)):
        if (view := board.find(render(RADTAN, T, seed=number))) is not None:
            true = RADTAN.project(view.points @ T[:3, :3].T + T[:3, 3])
            assert np.median(np.linalg.norm(view.pixels - true, axis=1)) < 0.2
            views.append(view)
    found = calibrate_camera(views, 18, *SIZE)
    assert found.camera.fx == pytest.approx(RADTAN.fx, rel=0.004)
    assert _worst_px(found, RADTAN) < 0.6


@pytest.mark.slow
def test_wrong_corners_and_wrong_images_are_left_out() -> None:
    views = exact_views(RADTAN, board_poses(30, seed=3), noise_px=0.1)
    for view in views[::6]:
        view.pixels[3] += (15.0, -9.0)
    np.random.default_rng(0).shuffle(views[5].pixels)  # of another board, say
    found = calibrate_camera(views, len(views), *SIZE, "radtan")
    assert len(views) - 4 <= len(found.views) < len(views)
    assert found.result.rms_px < 0.12
    assert _worst_px(found, RADTAN) < 0.6


def test_too_few_views_are_refused() -> None:
    views = exact_views(RADTAN, board_poses(40, seed=1))[:7]
    with pytest.raises(RecordingError, match="only 7 of 30 images show the board well, 8"):
        calibrate_camera(views, 30, *SIZE)


def test_a_board_on_one_side_is_refused_and_the_other_named() -> None:
    views = exact_views(RADTAN, board_poses(60, seed=1))
    left = [view for view in views if view.pixels[:, 0].max() < 420]
    assert len(left) >= 8
    with pytest.raises(
        RecordingError, match=r"cover \d+% of the image.*upper right.*hold it there"
    ):
        calibrate_camera(left, len(views), *SIZE)


def test_a_board_that_was_never_tilted_is_refused() -> None:
    flat = []
    for T in board_poses(60, seed=4, reach=0.6):
        centre = T[:3, :3] @ [0.135, 0.09, 0.0] + T[:3, 3]
        flat.append(se3.from_rotation_translation(np.eye(3), centre - [0.135, 0.09, 0.0]))
    views = exact_views(RADTAN, flat, noise_px=0.3)
    with pytest.raises(RecordingError, match=r"focal length stays uncertain.*tilt the board"):
        calibrate_camera(views, len(views), *SIZE, "radtan")


@pytest.mark.slow
def test_a_board_of_other_proportions_is_refused() -> None:
    views = exact_views(RADTAN, board_poses(40, seed=1))
    for view in views:
        view.points[:, 0] *= 1.0 + 0.4 * np.sin(40 * view.points[:, 0])  # it was bent
    with pytest.raises(RecordingError, match=r"px off|do not fit one camera"):
        calibrate_camera(views, len(views), *SIZE, "radtan")


def test_of_many_views_those_that_differ_are_chosen() -> None:
    same = exact_views(RADTAN, board_poses(1, seed=0)) * 200
    others = exact_views(RADTAN, board_poses(40, seed=1))
    chosen = choose([*same, *others], *SIZE)
    assert len(chosen) == MAX_VIEWS
    assert set(range(200, 200 + len(others))) <= set(chosen)


def test_it_finds_what_opencv_finds() -> None:
    views = exact_views(RADTAN, board_poses(20, seed=6, reach=0.6), noise_px=0.1)
    found = calibrate_camera(views, len(views), *SIZE, "radtan")
    guess = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    rms_px, K, lens, _, _ = cv2.calibrateCamera(
        [view.points.astype(np.float32) for view in found.views],
        [view.pixels.astype(np.float32) for view in found.views],
        SIZE,
        guess,
        np.zeros(5),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )
    camera = found.camera
    ours = [camera.fx, camera.fy, camera.cx, camera.cy]
    np.testing.assert_allclose(ours, [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], atol=0.02)
    np.testing.assert_allclose(camera.distortion, np.ravel(lens)[:5], atol=2e-4)
    assert found.result.rms_px * np.sqrt(2) == pytest.approx(rms_px, rel=1e-3)  # theirs: a point
