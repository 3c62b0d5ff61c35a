# SPDX-License-Identifier: Apache-2.0
"""A folder of photos of one camera, in it or in images/, with its calibration in camera.toml.

Photos have no times: they are taken as a second apart, in the order of their names.
"""

from pathlib import Path

from edge.cameras.layout import Layout
from edge.cameras.tables import a_second_apart
from edge.errors import ConfigError, RecordingError
from edge.geometry.camera import load_camera_file

_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff"}


def is_recording(root: Path) -> bool:
    """Tell whether `root` is such a folder."""
    listed = (root / "rgb.txt").exists() or not (root / "camera.toml").exists()
    return not listed and bool(_images(root))


def read(root: Path) -> Layout:
    """Layout of the folder; RecordingError says what is wrong with it."""
    try:
        file = load_camera_file(root / "camera.toml")
    except ConfigError as error:
        raise RecordingError(str(error)) from None
    images = _images(root)
    return Layout(
        root=root,
        camera=file.camera,
        rate_hz=1.0,
        t_ns=a_second_apart(len(images)),
        images=tuple(images),
        groundtruth=lambda: None,
    )


def _images(root: Path) -> list[Path]:
    for folder in (root / "images", root):
        if folder.is_dir():
            found = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
            if found:
                return sorted(found)
    return []
