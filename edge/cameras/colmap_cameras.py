# SPDX-License-Identifier: Apache-2.0
"""COLMAP's camera models as ours, where ours can carry them.

COLMAP's pixel centres lie at halves, ours on integers.
"""

from edge.errors import ConfigError, RecordingError
from edge.geometry.camera import CameraModel

# Number of a model in binary files: its name and how many parameters it has.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
_COUNTS = dict(MODELS.values())
# Those of one focal length; the others begin with two.
_ONE_FOCAL = {
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "SIMPLE_FISHEYE",
}
_CARRIED = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
)


def camera_of(
    model: str, width: int, height: int, parameters: list[float], where: str
) -> CameraModel:
    """Our camera of a COLMAP camera; RecordingError by `where` if we cannot carry its model."""
    if model not in _COUNTS or (model not in _CARRIED and not _is_plain_prism(model, parameters)):
        known = ", ".join(_CARRIED)
        raise RecordingError(
            f"{where}: model {model} cannot be carried; undistort to one of {known}"
        )
    if len(parameters) != _COUNTS[model]:
        message = f"{model} takes {_COUNTS[model]} parameters, there are {len(parameters)}"
        raise RecordingError(f"{where}: {message}")
    values = [parameters[0], *parameters] if model in _ONE_FOCAL else list(parameters)
    fx, fy, cx, cy, *k = values
    kind, distortion = _lens(model, k)
    try:
        return CameraModel(width, height, fx, fy, cx - 0.5, cy - 0.5, kind, distortion)
    except ConfigError as error:
        raise RecordingError(f"{where}: {error}") from None


def _is_plain_prism(model: str, parameters: list[float]) -> bool:
    """Tell whether a lens with prism terms has none that count."""
    return model == "THIN_PRISM_FISHEYE" and not any(
        parameters[i] for i in (6, 7, 10, 11) if i < len(parameters)
    )


def _lens(model: str, k: list[float]) -> tuple[str, tuple[float, ...]]:
    """Our distortion of COLMAP's; one of zeros is none."""
    if model.endswith("FISHEYE"):
        if model == "THIN_PRISM_FISHEYE":
            k = [k[0], k[1], k[4], k[5]]
        return "equidistant", (*k, *(0.0,) * (4 - len(k)))
    if not any(k):
        return "none", ()
    return "radtan", (*k, *(0.0,) * (4 - len(k)))
