# SPDX-License-Identifier: Apache-2.0
"""A look into an ONNX file without its library: opset, operators and types of weights.

Only what is needed of the protobuf wire format; unknown fields are passed over.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

from edge.errors import ModelRefused

_MAX_BYTES = 2_000_000_000  # what protobuf itself can hold
_GRAPH, _OPSET_IMPORT = 7, 8  # of ModelProto
_NODE, _INITIALIZER = 1, 5  # of GraphProto
_OP_TYPE = 4  # of NodeProto
_DATA_TYPE, _EXTERNAL_DATA = 2, 13  # of TensorProto
_KEY, _VALUE = 1, 2  # of StringStringEntryProto
_DOMAIN, _VERSION = 1, 2  # of OperatorSetIdProto
_FLOAT16 = 10
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_DYNAMIC_INT8 = {"DynamicQuantizeLinear", "DynamicQuantizeLSTM", "ConvInteger", "MatMulInteger"}

Field: TypeAlias = tuple[int, "int | memoryview"]


class OnnxFile(NamedTuple):
    """What was found in a file."""

    opset: int
    n_nodes: int
    is_dynamic_int8: bool  # quantises while it runs
    is_half: bool  # most weights are 16-bit floats
    beside: dict[str, int]  # other files in which weights lie: up to which byte


def look_into(path: Path) -> OnnxFile:
    """Read the outline of a model."""
    try:
        if path.exists() and not path.is_file():
            raise ModelRefused(f"{path}: is no file: name an ONNX file")
        if path.stat().st_size > _MAX_BYTES:
            raise ModelRefused(f"{path}: is larger than an ONNX file can be")
        data = memoryview(path.read_bytes())
    except OSError as error:
        raise ModelRefused(f"{path}: cannot be read: {error.strerror or error}") from error
    try:
        file = _outline(data)
    except (IndexError, ValueError):
        raise ModelRefused(f"{path}: is no ONNX file, or cut off") from None
    for name, end in file.beside.items():
        if why := _flaw(path.parent, name, end):
            raise ModelRefused(f"{path}: its weights lie in {name[:80]}, which {why}")
    return file


def _flaw(folder: Path, name: str, end: int) -> str:
    """Why a file of weights cannot be read; empty if it can."""
    if Path(name).is_absolute() or ".." in Path(name).parts:
        return "is not beside it: save the model with its weights in one folder"
    try:
        size = (folder / name).stat().st_size if (folder / name).is_file() else -1
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"
    if size < 0:
        return "is missing: copy it, too"
    return "is cut off: copy it again" if size < end else ""


def _outline(data: memoryview) -> OnnxFile:
    opset, operators, halves, weights, has_graph = 0, set[str](), 0, 0, False
    n_nodes, beside = 0, dict[str, int]()
    for number, value in _fields(data):
        if number == _OPSET_IMPORT:
            opset = max(opset, _main_opset(_inner(value)))
        if number != _GRAPH:
            continue
        has_graph = True
        for part, content in _fields(_inner(value)):
            if part == _NODE:
                n_nodes += 1
                operators.add(_operator(_inner(content)))
            elif part == _INITIALIZER:
                weights += 1
                fields = list(_fields(_inner(content)))
                halves += (_DATA_TYPE, _FLOAT16) in fields
                name, end = _place(fields)
                if name:
                    beside[name] = max(end, beside.get(name, 0))
    if not has_graph:
        raise ValueError("no graph")
    is_dynamic, is_half = bool(operators & _DYNAMIC_INT8), 2 * halves > weights
    return OnnxFile(opset, n_nodes, is_dynamic, is_half, beside)


def _place(fields: Sequence[Field]) -> tuple[str, int]:
    """The other file in which a tensor's numbers lie (empty: none), and where they end."""
    entries = {}
    for number, content in fields:
        if number == _EXTERNAL_DATA:
            entry = {n: bytes(_inner(value)).decode() for n, value in _fields(_inner(content))}
            entries[entry.get(_KEY)] = entry.get(_VALUE, "")
    name = entries.get("location", "")
    return name, int(entries.get("offset", "0")) + int(entries.get("length", "0"))


def _main_opset(data: memoryview) -> int:
    found = dict(_fields(data))
    domain = found.get(_DOMAIN, b"")
    version = found.get(_VERSION, 0)
    is_main = isinstance(version, int) and bytes(_inner(domain)) in (b"", b"ai.onnx")
    return version if is_main and isinstance(version, int) else 0


def _operator(data: memoryview) -> str:
    for number, value in _fields(data):
        if number == _OP_TYPE:
            return bytes(_inner(value)).decode("utf-8", "replace")
    return ""


def _inner(value: "int | bytes | memoryview") -> memoryview:
    if isinstance(value, int):
        raise ValueError("a number where a message should be")
    return memoryview(value)


def _fields(data: memoryview) -> Iterator[Field]:
    """Number and content of each field of one message."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        if kind == _VARINT:
            number, at = _varint(data, at)
            yield key >> 3, number
            continue
        if kind == _BYTES:
            length, at = _varint(data, at)
        elif kind in (_FIXED64, _FIXED32):
            length = 8 if kind == _FIXED64 else 4
        else:
            raise ValueError("unknown kind of field")
        if length > len(data) - at:
            raise ValueError("cut off")
        yield key >> 3, data[at : at + length]
        at += length


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return value, at
    raise ValueError("too long a number")
