# SPDX-License-Identifier: Apache-2.0
"""Calibrates a camera from views of a board, and says how good that is."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from edge.errors import RecordingError
from edge.geometry import distortion
from edge.geometry.calibration import (
    Calibrated,
    View,
    calibrate,
    refine_pose,
    residual_px,
)
from edge.geometry.camera import CameraModel
from edge.runtime import calibration_views
from edge.types import F64, Mat4

Model = Literal["auto", "radtan", "equidistant"]

_HELD_OUT_EVERY = 5
_FOCAL_GUESSES = (0.3, 0.5, 0.8, 1.2, 2.0)  # of the image's width
_GUESS_EVERY = 3  # a part of the views tells it well enough
_OUTLIER_SIGMAS = 5.0
_WORST_RMS_PX = 1.0
_WORST_FOCAL_SIGMA = 0.005  # relative; a board that was never tilted tells the focal length badly
_SIMPLER_WINS_BY = 1.01  # a lens that both fit is called by the commoner name
_LENSES = {
    "radtan": (distortion.RADTAN, (0.0,) * 5),
    "equidistant": (distortion.EQUIDISTANT, (0.0,) * 4),
}


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A camera and what speaks for it."""

    result: Calibrated
    views: tuple[View, ...]
    held_out_px: float  # rms on views that it was not made from
    images: int  # that were looked at

    @property
    def camera(self) -> CameraModel:
        """The camera."""
        return self.result.camera


def calibrate_camera(
    views: Sequence[View], images: int, width: int, height: int, model: Model = "auto"
) -> Calibration:
    """Calibrate from the views of the board that `images` images gave.

    RecordingError where they cannot tell the camera, or tell it badly.
    """
    calibration_views.check_enough(views, images, width, height)
    used = [views[i] for i in calibration_views.choose(views, width, height)]
    names = ("radtan", "equidistant") if model == "auto" else (model,)
    found = [_calibrate_model(used, images, width, height, name) for name in names]
    first = found[0]
    found.sort(key=lambda one: one.held_out_px * (1.0 if one is first else _SIMPLER_WINS_BY))
    problems = [_problem(one) for one in found]
    for one, problem in zip(found, problems, strict=True):
        if problem is None:
            return one
    raise RecordingError(problems[0] or "")


def _calibrate_model(
    views: Sequence[View], images: int, width: int, height: int, name: str
) -> Calibration:
    kind, coefficients = _LENSES[name]
    start, poses = _guess(views, width, height, kind)
    camera = CameraModel(width, height, start.fx, start.fy, start.cx, start.cy, kind, coefficients)
    cleaned, kept_poses = _without_outliers(calibrate(camera, views, poses), views)
    held_out = _held_out_px(camera, cleaned, kept_poses)
    result = calibrate(camera, cleaned, kept_poses)
    return Calibration(result, tuple(cleaned), held_out, images)


def _guess(
    views: Sequence[View], width: int, height: int, kind: str
) -> tuple[CameraModel, list[Mat4]]:
    """The rough focal length that explains the views best, and their poses by it."""
    best: tuple[float, CameraModel] | None = None
    coefficients = (0.0,) * 4 if kind == distortion.EQUIDISTANT else ()
    lens = kind if coefficients else distortion.NONE
    for share in _FOCAL_GUESSES:
        focal, centre = share * width, ((width - 1) / 2, (height - 1) / 2)
        camera = CameraModel(width, height, focal, focal, *centre, lens, coefficients)
        errors = [
            np.nan_to_num(residual_px(camera, view, _find_pose(camera, view)), nan=width)
            for view in views[::_GUESS_EVERY]
        ]
        score = float(np.median([np.abs(error).mean() for error in errors]))
        if best is None or score < best[0]:
            best = (score, camera)
    assert best is not None
    return best[1], [_find_pose(best[1], view) for view in views]


def _find_pose(camera: CameraModel, view: View) -> Mat4:
    """Pose of the board (4, 4) before a camera that is roughly known."""
    plane = camera.normalise(camera.undistort_pixels(view.pixels))
    good = np.isfinite(plane).all(axis=1) & (np.abs(plane) < 20.0).all(axis=1)
    T = np.eye(4)
    T[2, 3] = 1.0
    if good.sum() >= 4:
        _, turn, shift = cv2.solvePnP(
            view.points[good], plane[good], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    return T


def _without_outliers(result: Calibrated, views: Sequence[View]) -> tuple[list[View], list[Mat4]]:
    """Views and poses without corners that are far off and views that hold few others."""
    off = [np.nan_to_num(np.abs(residual), nan=np.inf) for residual in result.residuals]
    spread = 1.4826 * float(np.median([np.median(values) for values in off]))
    limit_px = max(_OUTLIER_SIGMAS * spread, 0.1)
    kept: list[View] = []
    poses: list[Mat4] = []
    for view, values, T in zip(views, off, result.T_cam_board, strict=True):
        good = values.max(axis=1) < limit_px
        if good.sum() >= max(6, len(good) // 2):
            kept.append(View(view.points[good], view.pixels[good]))
            poses.append(T)
    if len(kept) < calibration_views.MIN_VIEWS:
        raise RecordingError(
            f"the views do not fit one camera (only {len(kept)} of {len(views)} agree): the "
            "board must be flat, the focus fixed, and all images of one camera"
        )
    return kept, poses


def _held_out_px(camera: CameraModel, views: Sequence[View], poses: Sequence[Mat4]) -> float:
    """RMS of every fifth view, in turn by a camera made from the others alone."""
    squares: list[F64] = []
    for turn in range(2):
        inside = [i for i in range(len(views)) if i % _HELD_OUT_EVERY != turn]
        made = calibrate(camera, [views[i] for i in inside], [poses[i] for i in inside])
        for i in sorted(set(range(len(views))) - set(inside)):
            T = refine_pose(made.camera, views[i], poses[i])
            squares.append(residual_px(made.camera, views[i], T).ravel() ** 2)
    return float(np.sqrt(np.nanmean(np.concatenate(squares))))


def _problem(found: Calibration) -> str | None:
    """Why the views tell this camera badly, and what to do; None where they tell it well."""
    camera, result = found.camera, found.result
    if result.rms_px > _WORST_RMS_PX:
        return (
            f"the board's corners are {result.rms_px:.2f} px off (rms), {_WORST_RMS_PX:g} is the "
            "most: check --board, hold it flat and still, avoid blur; is the lens of another model?"
        )
    if not found.held_out_px < 2.0 * result.rms_px + 0.1:
        return (
            f"views that were left out are {found.held_out_px:.2f} px off, the others "
            f"{result.rms_px:.2f}: take more, at other places and tilts"
        )
    sigma = max(result.sigma[0] / camera.fx, result.sigma[1] / camera.fy)
    if not sigma < _WORST_FOCAL_SIGMA:
        return (
            f"the focal length stays uncertain by {sigma:.1%}: tilt the board by 30 degrees and "
            "more to all sides"
        )
    if not np.isfinite(camera.undistort_pixels(_must_be_seen(camera))).all():
        return (
            "the lens model folds back within the image: bring the board into its corners, or "
            "choose another --model"
        )
    return None


def _must_be_seen(camera: CameraModel) -> F64:
    """Pixels (n, 2) that the lens has to explain: a fisheye's corners may be dark."""
    w, h = camera.width - 1.0, camera.height - 1.0
    sides = np.array([[0, h / 2], [w, h / 2], [w / 2, 0], [w / 2, h]])
    corners = np.array([[0, 0], [w, 0], [0, h], [w, h]])
    is_fisheye = camera.distortion_model == distortion.EQUIDISTANT
    return sides if is_fisheye else np.concatenate((sides, corners))
