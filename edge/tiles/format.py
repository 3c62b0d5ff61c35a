# SPDX-License-Identifier: Apache-2.0
"""The bytes of one tile: named arrays behind a JSON header (safetensors layout).

Pure: bytes to arrays and back, no files. FORMAT.md is the specification. What
is read is never trusted: every number in a header is checked against the bytes
that are really there before an array is made.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge.errors import BadMagic, TileError

ALIGNMENT = 64  # bytes; every array begins on such a border of the file
MAX_HEADER_BYTES = 1 << 20
MAX_ARRAYS = 1024
MAX_DIMENSIONS = 4
MAX_NAME = 128
PADDING = "padding/"  # arrays of this name hold zeros between the others
METADATA = "__metadata__"
_LENGTH_BYTES = 8
_MAX_EMPTY_DIMENSION = 1 << 15  # of an array without elements: NumPy multiplies the others

DTYPES = {
    "BOOL": np.dtype("?"),
    "U8": np.dtype("u1"),
    "I8": np.dtype("i1"),
    "U16": np.dtype("<u2"),
    "I16": np.dtype("<i2"),
    "F16": np.dtype("<f2"),
    "U32": np.dtype("<u4"),
    "I32": np.dtype("<i4"),
    "F32": np.dtype("<f4"),
    "U64": np.dtype("<u8"),
    "I64": np.dtype("<i8"),
    "F64": np.dtype("<f8"),
}
_NAMES = {dtype: name for name, dtype in DTYPES.items()}

Array: TypeAlias = NDArray[Any]
_Count = Annotated[int, msgspec.Meta(ge=0, le=(1 << 53))]


class _Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    dtype: str
    shape: Annotated[list[_Count], msgspec.Meta(max_length=MAX_DIMENSIONS)]
    data_offsets: tuple[_Count, _Count]


_header_decoder = msgspec.json.Decoder(dict[str, msgspec.Raw])
_entry_decoder = msgspec.json.Decoder(_Entry)
_metadata_decoder = msgspec.json.Decoder(dict[str, str])


def encode(arrays: Mapping[str, Array], metadata: Mapping[str, str] | None = None) -> bytes:
    """Return the bytes of a tile that holds `arrays`, in their order, and `metadata`.

    The same input gives the same bytes.
    """
    header: dict[str, Any] = {METADATA: dict(metadata or {})}
    chunks: list[bytes] = []
    end = 0
    for name, array in _padded(arrays):
        if array.dtype not in _NAMES:
            raise ValueError(f"array {name}: a tile cannot hold {array.dtype}")
        data = array.tobytes()
        header[name] = {
            "dtype": _NAMES[array.dtype],
            "shape": list(array.shape),
            "data_offsets": [end, end + len(data)],
        }
        chunks.append(data)
        end += len(data)
    text = msgspec.json.encode(header)
    text += b" " * (-(_LENGTH_BYTES + len(text)) % ALIGNMENT)
    if len(text) > MAX_HEADER_BYTES or len(header) > MAX_ARRAYS:
        raise ValueError(f"{len(arrays)} arrays are too many for one tile")
    return b"".join([len(text).to_bytes(_LENGTH_BYTES, "little"), text, *chunks])


def _padded(arrays: Mapping[str, Array]) -> Iterator[tuple[str, Array]]:
    """Yield the arrays with zeros between them, so that each begins aligned."""
    for number, (name, array) in enumerate(arrays.items()):
        yield name, array
        if gap := -array.nbytes % ALIGNMENT:
            yield f"{PADDING}{number}", np.zeros(gap, np.uint8)


def decode(data: memoryview, origin: str) -> tuple[dict[str, Array], dict[str, str]]:
    """Return the arrays and the metadata of a tile as views into `data`, nothing copied.

    `origin` names the file in the `TileError` that anything wrong raises.
    """
    start, entries = _read_header(data, origin)
    metadata: dict[str, str] = {}
    if METADATA in entries:
        metadata = _parse(_metadata_decoder, entries.pop(METADATA), f"{origin}: its metadata")
    arrays: dict[str, Array] = {}
    end = 0
    for name, raw in entries.items():
        where = f"{origin}: array {name[:MAX_NAME]!r}"
        if len(name) > MAX_NAME:
            raise TileError(f"{where} has too long a name; build or copy the map again")
        entry = _parse(_entry_decoder, raw, where)
        begin, stop = _checked_extent(entry, where)
        if begin % ALIGNMENT and not name.startswith(PADDING):
            raise TileError(f"{where} is not on a {ALIGNMENT}-byte border; build the map again")
        if begin != end:
            raise TileError(f"{where} overlaps or leaves a hole; build or copy the map again")
        if start + stop > len(data):
            raise TileError(f"{where} ends beyond the file; it is cut short, copy it again")
        end = stop
        if not name.startswith(PADDING):
            arrays[name] = _view(data, start + begin, entry)
    if start + end != len(data):
        raise TileError(f"{origin} has bytes that no array names; build or copy the map again")
    return arrays, metadata


def _read_header(data: memoryview, origin: str) -> tuple[int, dict[str, msgspec.Raw]]:
    if len(data) < _LENGTH_BYTES + 2:
        raise TileError(f"{origin} is cut short ({len(data)} bytes); copy it again")
    length = int.from_bytes(data[:_LENGTH_BYTES], "little")
    if length > MAX_HEADER_BYTES or data[_LENGTH_BYTES] != ord("{"):
        raise BadMagic(f"{origin} is no tile: it does not begin like one")
    start = _LENGTH_BYTES + length
    if start > len(data):
        raise TileError(f"{origin} is cut short within its header; copy it again")
    if start % ALIGNMENT:
        raise TileError(f"{origin} is not laid out on {ALIGNMENT}-byte borders; build it again")
    header = _parse(_header_decoder, bytes(data[_LENGTH_BYTES:start]), f"{origin}: its header")
    if len(header) > MAX_ARRAYS:
        raise TileError(f"{origin} names {len(header)} arrays; at most {MAX_ARRAYS} are read")
    return start, header


def _parse(decoder: msgspec.json.Decoder[Any], raw: bytes | msgspec.Raw, where: str) -> Any:
    try:
        return decoder.decode(raw)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise TileError(f"{where} cannot be read ({error}); build or copy the map again") from None


def _checked_extent(entry: _Entry, where: str) -> tuple[int, int]:
    if entry.dtype not in DTYPES:
        raise TileError(f"{where} is of type {entry.dtype[:16]!r}, which no tile holds")
    begin, stop = entry.data_offsets
    count = math.prod(entry.shape)
    absurd = count == 0 and max(entry.shape) > _MAX_EMPTY_DIMENSION
    if absurd or stop - begin != count * DTYPES[entry.dtype].itemsize:
        raise TileError(f"{where}: its shape and its bytes disagree; build or copy the map again")
    return begin, stop


def _view(data: memoryview, begin: int, entry: _Entry) -> Array:
    count = math.prod(entry.shape)
    if count == 0:
        empty = np.empty(entry.shape, DTYPES[entry.dtype])
        empty.flags.writeable = False
        return empty
    return np.frombuffer(data, DTYPES[entry.dtype], count, begin).reshape(entry.shape)
