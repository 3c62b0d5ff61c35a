# SPDX-License-Identifier: Apache-2.0
"""Whether both halves of the images ask for the lens that was found for all; else it is undone.

With little motion a coefficient of distortion bends to the noise of a few points: on the first
100 frames of an exact pinhole camera (34 cm of path) the halves found -0.017 and +0.007. Where a
lens really is off they agree: -0.027 and -0.029 for redkitchen's.
"""

from pathlib import Path
from typing import Any

import numpy as np

from maps.sfm.job import Job, may_refine

_LEAST_IMAGES = 5  # of a half
_MAX_DIFFERENCE = 0.5  # of the coefficient


def confirm_lenses(colmap: Any, job: Job, folder: Path) -> None:
    """Undo coefficients of the model in `folder` that its halves do not agree on."""
    whole = colmap.Reconstruction(folder)
    found = _coefficients(whole, job)
    if not any(found.values()):
        return
    parts = [_coefficients(_half(colmap, folder, number), job) for number in (0, 1)]
    doubtful = [
        camera
        for camera, k1 in found.items()
        if not all(camera in part for part in parts)
        or abs(parts[0][camera] - parts[1][camera]) > _MAX_DIFFERENCE * abs(k1)
    ]
    if not doubtful:
        return
    for camera in doubtful:
        model = whole.cameras[camera + 1]
        model.params = [*model.params[:3], 0.0]
    colmap.bundle_adjustment(whole, _options(colmap, refine_lens=False))
    whole.write(folder)


def _coefficients(model: Any, job: Job) -> dict[int, float]:
    """The coefficient of each camera that may be refined, if it has enough images."""
    images = [image.camera_id - 1 for image in model.images.values() if image.has_pose]
    return {
        camera: float(model.cameras[camera + 1].params[3])
        for camera in sorted(set(images))
        if may_refine(job, camera) and images.count(camera) >= _LEAST_IMAGES
    }


def _half(colmap: Any, folder: Path, number: int) -> Any:
    """The model of one half of its images, fitted anew."""
    model = colmap.Reconstruction(folder)
    halves = np.array_split(sorted(model.reg_frame_ids()), 2)
    for frame in halves[1 - number].tolist():
        model.deregister_frame(frame)
    colmap.bundle_adjustment(model, _options(colmap, refine_lens=True))
    return model


def _options(colmap: Any, *, refine_lens: bool) -> Any:
    options = colmap.BundleAdjustmentOptions()
    options.refine_focal_length = False
    options.refine_principal_point = False
    options.refine_extra_params = refine_lens
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    return options
