# SPDX-License-Identifier: Apache-2.0
"""Opens ONNX models: one thread that never spins, and what goes wrong in one line.

ONNX Runtime is imported here only, so whoever needs no model is spared it.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import onnxruntime as ort
from numpy import ndarray
from numpy.typing import NDArray

from edge.errors import ModelRefused
from edge.onnx.outline import OnnxFile
from edge.onnx.tensor import Tensor

Session: TypeAlias = ort.InferenceSession


def open_session(path: Path, file: OnnxFile) -> Session:
    """Open a model for one thread; ModelRefused says why that cannot be."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = 4  # what is wrong is raised, too
    try:
        return ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001  # those of ONNX Runtime have no base in common
        text = str(error).lower()
        if "ir version" in text:
            why = f"is of a newer form than ONNX Runtime {ort.__version__} knows: {_brief(error)}"
            raise ModelRefused(f"{why}: export it with an older onnx") from None
        if "opset" in text:
            why = f"needs opset {file.opset}, which ONNX Runtime {ort.__version__} does not know"
            raise ModelRefused(f"{why}: export it with a lower opset") from None
        raise ModelRefused(f"ONNX Runtime does not open it: {_brief(error)}") from None


def inputs_of(session: Session) -> list[Tensor]:
    """What a model asks for."""
    return [_tensor(node) for node in session.get_inputs()]


def run(session: Session, feed: Mapping[str, NDArray[Any]], what: str) -> dict[str, NDArray[Any]]:
    """All outputs by name; `what` says in an error on what it was run."""
    names = [node.name for node in session.get_outputs()]
    try:
        arrays = session.run(names, feed)
    except Exception as error:  # noqa: BLE001
        raise ModelRefused(f"does not run on {what}: {_brief(error)}") from None
    if not all(isinstance(array, ndarray) for array in arrays):
        raise ModelRefused("gives what is no array: export it without sequences")
    return dict(zip(names, arrays, strict=True))


def _brief(error: Exception) -> str:
    """The first line of what ONNX Runtime says, without its own places."""
    lines = str(error).strip().splitlines()
    return (lines[0] if lines else type(error).__name__).split("Status Message: ")[-1][:200]


def _tensor(node: Any) -> Tensor:
    axes = tuple(axis if isinstance(axis, int) else -1 for axis in node.shape)
    dtype = node.type.removeprefix("tensor(").removesuffix(")")
    return Tensor(node.name, {"float": "float32"}.get(dtype, dtype), axes)
