# SPDX-License-Identifier: Apache-2.0
"""An opened model: what it expects is settled once, tried out, and then only followed.

It loads ONNX Runtime: this module is for the model's own process.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.config.segmenter import SegmenterConfig
from edge.errors import ModelRefused
from edge.onnx import session as onnx_session
from edge.onnx.outline import OnnxFile, look_into
from edge.onnx.tensor import Tensor, tensors
from edge.segmenter import metadata
from edge.segmenter.contract import (
    Contract,
    InputForm,
    OutputForm,
    Sidecar,
    read_sidecar,
    sidecar_path,
)
from edge.segmenter.decode import decode
from edge.segmenter.inputs import settle_input, to_tensor
from edge.segmenter.letterbox import fill, lay_out
from edge.segmenter.recognise import recognise, refuse
from edge.types import U8, Detections

_LARGE_SIDE = 640  # above it one core is too slow to be of use beside poses
_DRY_SEED = 8


class Model:
    """A model ready to segment. Raises ModelRefused, in one line, where it cannot be used."""

    def __init__(self, path: Path, config: SegmenterConfig) -> None:
        self._config = config
        file = look_into(path)
        sidecar = read_sidecar(path)
        try:
            self._open(path, file, sidecar)
        except ModelRefused as error:
            text = str(error).replace("MODEL.onnx.toml", sidecar_path(path).name)
            raise ModelRefused(f"{path}: {text}") from error

    def segment(self, image: U8) -> Detections:
        """What it sees in an image (h, w) grey or (h, w, 3) red first.

        Raises ModelRefused where it gives nonsense, such as NaN.
        """
        form = self.contract.input
        size = (image.shape[1], image.shape[0])
        letterbox = lay_out(size, (form.width, form.height), form.fit)
        outputs = self._run(form, fill(image, letterbox, form.pad))
        by_role = {role: outputs[name] for role, name in self.contract.output.roles.items()}
        return decode(by_role, self.contract, letterbox, self._config)

    def _open(self, path: Path, file: OnnxFile, sidecar: Sidecar | None) -> None:
        self._session = onnx_session.open_session(path, file)
        said = self._session.get_modelmeta().custom_metadata_map
        declared = sidecar.convention if sidecar else None
        if declared is None:
            metadata.check_task(said)
        inputs = onnx_session.inputs_of(self._session)
        form = settle_input(inputs, sidecar, metadata.read_size(said))
        outputs = self._run(form, _dry_picture(form))
        given = tensors(outputs)
        names = sidecar.names if sidecar and sidecar.names else metadata.read_names(said)
        named = sidecar.outputs if sidecar else {}
        output = recognise(
            given, (form.width, form.height), len(names) if names else None, declared, named
        )
        self.contract = Contract(
            input=settle_input(inputs, sidecar, metadata.read_size(said), output.convention),
            output=output,
            names=_settle_names(names, output, given),
            source="its sidecar" if declared else "metadata and shapes" if names else "shapes",
            outputs=given,
            warnings=_warn(file, form, names),
        )
        self._try_out()

    def _try_out(self) -> None:
        """Run on noise and on nothing, so that nonsense shows before it is needed."""
        form = self.contract.input
        noise = np.random.default_rng(_DRY_SEED).integers(0, 256, (form.height, form.width, 3))
        for picture in (noise.astype(np.uint8), np.zeros((form.height, form.width, 3), np.uint8)):
            self.segment(picture)

    def _run(self, form: InputForm, picture: U8) -> dict[str, NDArray[Any]]:
        feed = {form.name: to_tensor(picture, form)}
        return onnx_session.run(self._session, feed, f"{form.width}x{form.height}")


def _dry_picture(form: InputForm) -> U8:
    return np.full((form.height, form.width, 3), form.pad, np.uint8)


def _settle_names(
    names: tuple[str, ...] | None, output: OutputForm, given: Sequence[Tensor]
) -> tuple[str, ...]:
    n_classes = output.n_classes
    if names is None and n_classes is None:
        raise refuse("nothing names its classes: give names in MODEL.onnx.toml", given)
    if names is None:
        return tuple(f"class {i}" for i in range(n_classes or 0))
    if n_classes is not None and len(names) != n_classes:
        why = f"it is told {len(names)} names of classes, but its outputs are for {n_classes}"
        raise refuse(f"{why}: give the names it was trained with", given)
    return names


def _warn(file: OnnxFile, form: InputForm, names: tuple[str, ...] | None) -> tuple[str, ...]:
    found: Mapping[str, bool] = {
        "is quantised dynamically: some five times slower than float32; quantise it statically": (
            file.is_dynamic_int8
        ),
        "has 16-bit floats, which a CPU converts at each step: export it with float32": (
            file.is_half or form.dtype == "float16"
        ),
        f"works on {form.width}x{form.height}: 320x320 is several times faster": (
            max(form.width, form.height) > _LARGE_SIDE
        ),
        "names no classes: they are numbered; give names in a sidecar": names is None,
    }
    return tuple(text for text, holds in found.items() if holds)
