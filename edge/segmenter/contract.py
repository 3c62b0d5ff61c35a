# SPDX-License-Identifier: Apache-2.0
"""What a model expects and says, once it is known."""

from pathlib import Path
from typing import Literal, TypeAlias

from msgspec import Struct

from edge.config.loader import load_struct
from edge.errors import ModelRefused
from edge.onnx.tensor import Tensor

Convention: TypeAlias = Literal["yolov8", "yolov5", "end2end", "rtmdet", "maskrcnn", "yolact"]
Fit: TypeAlias = Literal["centre", "corner", "stretch"]
Channels: TypeAlias = Literal["rgb", "bgr"]
Colour: TypeAlias = tuple[float, float, float]

SIDECAR_SUFFIX = ".toml"


class InputForm(Struct, frozen=True):
    """The model's input: (pixel - mean) / std of each channel, pixels 0 to 255."""

    name: str
    dtype: Literal["float32", "float16", "uint8"]
    layout: Literal["nchw", "nhwc", "chw"]
    width: int
    height: int
    channels: Channels = "rgb"
    mean: Colour = (0.0, 0.0, 0.0)
    std: Colour = (255.0, 255.0, 255.0)
    fit: Fit = "centre"
    pad: int = 114


class OutputForm(Struct, frozen=True):
    """How outputs are read: `roles` names the output of each part."""

    convention: Convention
    roles: dict[str, str]
    n_classes: int | None = None  # as its shapes say; None where they say nothing
    columns_first: bool = False  # a dense head (1, columns, rows)


class Contract(Struct, frozen=True):
    """All that is needed to run a model and to read what it says."""

    input: InputForm
    output: OutputForm
    names: tuple[str, ...]
    source: str  # where the convention is known from
    outputs: tuple[Tensor, ...]
    warnings: tuple[str, ...] = ()


class Sidecar(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The file `MODEL.onnx.toml`: whatever it names is believed, before all else."""

    convention: Convention | None = None
    names: tuple[str, ...] | None = None
    width: int | None = None
    height: int | None = None
    channels: Channels | None = None
    mean: Colour | None = None
    std: Colour | None = None
    fit: Fit | None = None
    pad: int | None = None
    outputs: dict[str, str] = {}


def sidecar_path(model: Path) -> Path:
    """Where the sidecar of a model lies."""
    return model.with_name(model.name + SIDECAR_SUFFIX)


def read_sidecar(model: Path) -> Sidecar | None:
    """The model's sidecar; None where it has none."""
    path = sidecar_path(model)
    if not path.exists():
        return None
    sidecar = load_struct(path, Sidecar)
    if sidecar.names is not None and not all(sidecar.names):
        raise ModelRefused(f"{path}: names: a class without a name; give each one")
    for key, size in (("width", sidecar.width), ("height", sidecar.height)):
        if size is not None and not 32 <= size <= 4096:
            raise ModelRefused(f"{path}: {key} = {size}: must be 32 to 4096")
    if sidecar.std is not None and min(sidecar.std) <= 0.0:
        raise ModelRefused(f"{path}: std: must be above 0")
    if sidecar.pad is not None and not 0 <= sidecar.pad <= 255:
        raise ModelRefused(f"{path}: pad = {sidecar.pad}: must be 0 to 255")
    return sidecar
