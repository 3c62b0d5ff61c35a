# SPDX-License-Identifier: Apache-2.0
"""A camera as the text of a camera.toml."""

import json

from edge.geometry.camera import CameraModel


def camera_toml(camera: CameraModel, rate_hz: float | None = None, identity: str = "") -> str:
    """Text that `load_camera_file` reads back as the same camera, to the last bit."""
    lines = [
        f"width = {camera.width}",
        f"height = {camera.height}",
        *(f"{key} = {_number(getattr(camera, key))}" for key in ("fx", "fy", "cx", "cy")),
        f'distortion_model = "{camera.distortion_model}"',
        f"distortion = [{', '.join(map(_number, camera.distortion))}]",
    ]
    if rate_hz is not None:
        lines.append(f"rate_hz = {_number(rate_hz)}")
    if identity:
        lines.append(f"identity = {json.dumps(identity, ensure_ascii=False)}")
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    """Shortest text of the same float64; TOML takes Python's form."""
    return repr(float(value))
