# SPDX-License-Identifier: Apache-2.0
"""COLMAP workspaces: a sparse model, its images and, where it is dense, its depth maps.

    sparse/0/ or sparse/ or ./      cameras, images, points3D; .bin or .txt
    images/                         by the names in the model
    stereo/depth_maps/NAME.geometric.bin    in a dense workspace

The folder of the workspace or that of one model in it may be given. Such images have no times: they
are taken as a second apart, in the order of their names. The unit of the poses is not known.
"""

from pathlib import Path

import cv2
import numpy as np

from edge.cameras import colmap_files
from edge.cameras.colmap_files import ModelImage
from edge.cameras.groundtruth import GroundTruth
from edge.cameras.images import is_file, read_bytes
from edge.cameras.layout import Depths, Layout, Lenses
from edge.cameras.tables import a_second_apart
from edge.errors import RecordingError
from edge.geometry.camera import CameraModel
from edge.types import F32

_LEVELS_UP = 3  # from workspace/sparse/0 to the folder of images


def is_recording(root: Path) -> bool:
    """Tell whether `root` is such a workspace, or a model in one."""
    return colmap_files.has_model(root) or bool(_models(root))


def read(root: Path) -> Layout:
    """Layout of the workspace; RecordingError says what is wrong with it."""
    model = _model(root)
    cameras = colmap_files.read_cameras(model)
    images = colmap_files.read_images(model)
    for image in images:
        if image.camera not in cameras:
            raise RecordingError(
                f"{model}: image {image.name} is of camera {image.camera}, which is not there"
            )
    base = _base(model, images)
    lenses = Lenses.of([cameras[image.camera] for image in images])
    t_ns = a_second_apart(len(images))
    return Layout(
        root=root,
        camera=lenses.cameras[0],
        rate_hz=1.0,
        t_ns=t_ns,
        images=tuple(base / image.name for image in images),
        groundtruth=lambda: GroundTruth.of(t_ns, [image.T_world_cam for image in images]),
        depths=_depths(base, images),
        lenses=lenses,
        metric=False,
    )


def read_depth(path: Path, camera: CameraModel) -> F32:
    """Depth (h, w) float32 of a depth map, in the size of its camera's images.

    The maps of large images are made smaller; a pixel takes the depth that lies nearest, as
    depths of two surfaces must not be mixed.
    """
    depth = colmap_files.read_depth(path, read_bytes(path))
    size = (camera.width, camera.height)
    if depth.shape[::-1] != size:
        depth = np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), np.float32)
    return depth


def _models(root: Path) -> list[Path]:
    """Folders of models below root/sparse."""
    sparse = root / "sparse"
    if colmap_files.has_model(sparse):
        return [sparse]
    if not sparse.is_dir():
        return []
    return sorted(folder for folder in sparse.iterdir() if colmap_files.has_model(folder))


def _model(root: Path) -> Path:
    if colmap_files.has_model(root):
        return root
    models = _models(root)
    if len(models) > 1:
        counts = [len(colmap_files.read_images(folder)) for folder in models]
        parts = ", ".join(f"{f.name}: {n} images" for f, n in zip(models, counts, strict=True))
        raise RecordingError(
            f"{root / 'sparse'}: holds {len(models)} models that are not connected ({parts}); "
            f"give one, as in {models[0]}"
        )
    return models[0]


def _base(model: Path, images: list[ModelImage]) -> Path:
    """Folder that the images' names begin at."""
    above = [model, *model.resolve().parents][: _LEVELS_UP + 1]
    for folder in [folder / "images" for folder in above] + above:
        if any(is_file(folder / image.name) for image in images):
            return folder
    raise RecordingError(
        f"{model}: image {images[0].name} lies neither in images/ beside the model nor in a folder "
        "above it; put the images there"
    )


def _depths(base: Path, images: list[ModelImage]) -> Depths | None:
    folder = base.parent / "stereo" / "depth_maps"
    if base.name != "images" or not folder.is_dir():
        return None
    paths = [folder / f"{image.name}.geometric.bin" for image in images]
    found = tuple(path if is_file(path) else None for path in paths)
    return Depths(found, 1.0, in_pose_units=True) if any(found) else None
