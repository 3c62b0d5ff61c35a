# SPDX-License-Identifier: Apache-2.0
import json
import struct

import numpy as np
import pytest

from edge.errors import BadMagic, TileError
from edge.tiles import format as tile_format

ARRAYS = {
    "poses": np.arange(32, dtype=np.float64).reshape(2, 4, 4),
    "few": np.array([1, 2, 3], np.uint8),
    "none": np.empty((0, 32), np.uint8),
    "half": np.array([[0.5, -2.0]], np.float16),
    "flag": np.array([True, False]),
    "scalar": np.array(7, np.int64),
}


def encoded() -> bytes:
    return tile_format.encode(ARRAYS, {"kind": "test"})


def decode(data: bytes) -> dict[str, np.ndarray]:
    return tile_format.decode(memoryview(data), "some.tile")[0]


def with_header(header: object, body: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    text += b" " * (-(8 + len(text)) % 64)
    return struct.pack("<Q", len(text)) + text + body


def entry(begin: int, end: int, dtype: str = "U8", shape: object = None) -> dict[str, object]:
    return {
        "dtype": dtype,
        "shape": [end - begin] if shape is None else shape,
        "data_offsets": [begin, end],
    }


def test_what_goes_in_comes_out_with_its_type_shape_and_metadata() -> None:
    arrays, metadata = tile_format.decode(memoryview(encoded()), "some.tile")
    assert metadata == {"kind": "test"}
    assert list(arrays) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype
        assert arrays[name].shape == array.shape
        assert np.array_equal(arrays[name], array)


def test_arrays_are_aligned_views_that_nobody_can_write() -> None:
    data = encoded()
    start = np.frombuffer(data, np.uint8).ctypes.data
    for array in decode(data).values():
        assert not array.flags.writeable
        if array.size:
            assert (array.ctypes.data - start) % tile_format.ALIGNMENT == 0
            assert start <= array.ctypes.data < start + len(data)


def test_the_same_arrays_give_the_same_bytes() -> None:
    assert encoded() == encoded()


def test_a_type_that_the_format_lacks_is_refused_when_written() -> None:
    with pytest.raises(ValueError, match="complex"):
        tile_format.encode({"wave": np.zeros(3, np.complex64)})


def test_a_file_cut_at_any_byte_is_refused() -> None:
    data = encoded()
    for length in range(len(data)):
        with pytest.raises(TileError, match=r"some\.tile"):
            decode(data[:length])


def test_bytes_after_the_last_array_are_refused() -> None:
    with pytest.raises(TileError, match="no array names"):
        decode(encoded() + b"\0")


def test_every_flipped_bit_of_the_header_is_refused_or_leaves_arrays_in_bounds() -> None:
    data = encoded()
    header = 8 + int.from_bytes(data[:8], "little")
    for position in range(8 * header):
        spoiled = bytearray(data)
        spoiled[position // 8] ^= 1 << (position % 8)
        try:
            arrays = decode(bytes(spoiled))
        except TileError:
            continue
        assert sum(array.nbytes for array in arrays.values()) <= len(data)


@pytest.mark.parametrize(
    "header",
    [
        {"a": entry(0, 64), "b": entry(0, 64)},
        {"a": entry(64, 128)},
        {"b": entry(64, 128), "a": entry(0, 64)},
        {"a": entry(0, 1 << 60)},
        {"a": entry(0, 1 << 70)},
        {"a": entry(0, 128, "F64", [-1, -16])},
        {"a": entry(0, 128, "F64", [1 << 62, 1 << 62])},
        {"a": entry(0, 128, "F64", [8])},
        {"a": entry(0, 128, "F64", [2] * 5)},
        {"a": entry(0, 0, "F64", [0, 1 << 50])},
        {"a": entry(0, 0, "F64", [0, 1 << 53, 1 << 53])},
        {"a": entry(0, 128, "object")},
        {"a": entry(0, 128, "F128", [8])},
        {"a": {**entry(0, 128), "more": 1}},
        {"a": {"dtype": "U8", "shape": [128]}},
        {"a": entry(0, 1), "b": entry(1, 128)},
        {"a" * 200: entry(0, 128)},
        {"__metadata__": {"a": 1}},
        {"__metadata__": []},
        [],
        7,
        b"{" * 1000,
        b'{"a":' * 5000,
        b"\xff\xfe{}",
        b'{"a": \xff}',
    ],
)
def test_headers_that_lie_are_refused(header: object) -> None:
    with pytest.raises(TileError, match=r"some\.tile"):
        decode(with_header(header, bytes(128)))


@pytest.mark.parametrize("length", [0, 1, 1 << 21, 1 << 40, (1 << 64) - 1])
def test_an_absurd_header_length_is_refused(length: int) -> None:
    data = bytearray(encoded())
    data[:8] = struct.pack("<Q", length)
    with pytest.raises(TileError):
        decode(bytes(data))


def test_another_kind_of_file_is_no_tile() -> None:
    with pytest.raises(BadMagic):
        decode(b"\x89PNG\r\n\x1a\n" + bytes(500))


def test_too_many_arrays_are_refused() -> None:
    header = {f"{i}": entry(0, 0) for i in range(tile_format.MAX_ARRAYS + 1)}
    with pytest.raises(TileError, match="at most"):
        decode(with_header(header))
    with pytest.raises(ValueError, match="too many"):
        tile_format.encode({f"{i}": np.zeros(1) for i in range(tile_format.MAX_ARRAYS)})


def test_only_padding_may_begin_between_borders() -> None:
    good = {"a": entry(0, 1), "padding/0": entry(1, 64), "b": entry(64, 65)}
    assert list(decode(with_header(good, bytes(65)))) == ["a", "b"]
