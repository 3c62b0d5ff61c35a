# SPDX-License-Identifier: Apache-2.0
"""Maps with anything in them: they open and work, or one TileError says which file is wrong."""

import hashlib
import json
import os
import shutil
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from edge.tiles import format as tile_format
from edge.tiles import manifest as manifest_format
from tests.maps.small_map import edited_manifest, write_small_map
from tools.fuzz.reading import read_everything

MAX_BYTES = 30_000_000  # that a map of half a megabyte may make a reader take
# `pytest -p tools.fuzz.long` tries thousands, other ones each time; here always the same few.
LONG = settings.default is not None and settings.default.max_examples > 100
HOSTILE = settings(
    max_examples=settings.default.max_examples if settings.default and LONG else 25,
    derandomize=not LONG,
    deadline=None,  # a loaded machine is slow, not wrong
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

WILD = st.sampled_from(
    [0, 1, -1, 255, 256, 65535, 2**31 - 1, -(2**31), 2**32 - 1, 2**53, 2**63 - 1, 10**30, 1e308]
)


def places_in(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths to everything in a JSON value."""
    yield path
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, inner in items:
        yield from places_in(inner, (*path, key))


class Template:
    """A small map that each example spoils a copy of."""

    def __init__(self, folder: Path) -> None:
        write_small_map(folder)
        self.folder = folder
        with edited_manifest(folder) as table:
            self.manifest = json.dumps(table).encode()
        self.places = [place for place in places_in(table) if place]
        entry = table["tiles"][0]
        self.tile_path = entry["path"]
        self.tile = (folder / self.tile_path).read_bytes()
        self.arrays, _ = tile_format.decode(memoryview(self.tile), "template")

    def copy(self, place: Path, manifest: bytes | None, tile: bytes | None) -> Path:
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(self.folder / "tiles", place / "tiles", copy_function=os.link)
        if tile is not None:
            (place / self.tile_path).unlink()  # a link to the template's
            (place / self.tile_path).write_bytes(tile)
            table = json.loads(self.manifest)
            table["tiles"][0]["bytes"] = len(tile)
            table["tiles"][0]["sha256"] = hashlib.sha256(tile).hexdigest()  # as who forges it would
            manifest = json.dumps(table).encode()
        (place / manifest_format.FILE_NAME).write_bytes(manifest or self.manifest)
        return place


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Template]:
    made = Template(tmp_path_factory.mktemp("template") / "map")
    read_everything(made.folder)  # what is compiled and loaded once counts for no example
    tracemalloc.start()
    yield made
    tracemalloc.stop()


def read(
    template: Template, place: Path, *, manifest: bytes | None = None, tile: bytes | None = None
) -> bool:
    folder = template.copy(place, manifest, tile)
    tracemalloc.reset_peak()
    before, _ = tracemalloc.get_traced_memory()
    good = read_everything(folder)
    _, peak = tracemalloc.get_traced_memory()
    assert peak - before < MAX_BYTES, f"took {peak - before} bytes"
    return good


def spoil(data: bytes, edits: list[tuple[int, int]]) -> bytes:
    changed = bytearray(data)
    for place, value in edits:
        changed[place % len(changed)] = value
    return bytes(changed)


EDITS = st.lists(st.tuples(st.integers(0, 2**31), st.integers(0, 255)), min_size=1, max_size=8)


def test_the_template_itself_can_be_used(template: Template, tmp_path: Path) -> None:
    assert read(template, tmp_path / "map", manifest=template.manifest)
    assert read(template, tmp_path / "map", tile=template.tile)


@HOSTILE
@given(edits=EDITS)
def test_bytes_of_a_tile(template: Template, tmp_path: Path, edits: list[tuple[int, int]]) -> None:
    read(template, tmp_path / "map", tile=spoil(template.tile, edits))


@HOSTILE
@given(edits=EDITS)
def test_bytes_of_a_header(
    template: Template, tmp_path: Path, edits: list[tuple[int, int]]
) -> None:
    length = 8 + int.from_bytes(template.tile[:8], "little")
    head = spoil(template.tile[:length], edits)
    read(template, tmp_path / "map", tile=head + template.tile[length:])


@HOSTILE
@given(length=st.integers(0, 2**31), tail=st.binary(max_size=64))
def test_a_tile_cut_short_or_grown(
    template: Template, tmp_path: Path, length: int, tail: bytes
) -> None:
    cut = template.tile[: length % (len(template.tile) + 1)]
    assert not read(template, tmp_path / "map", tile=cut + tail) or cut + tail == template.tile


@HOSTILE
@given(data=st.data())
def test_numbers_of_a_header(template: Template, tmp_path: Path, data: st.DataObject) -> None:
    length = int.from_bytes(template.tile[:8], "little")
    header = json.loads(template.tile[8 : 8 + length])
    name = data.draw(st.sampled_from([key for key in header if key != tile_format.METADATA]))
    entry = header[name]
    where = data.draw(st.sampled_from(["shape", "data_offsets", "dtype", "more"]))
    if where == "dtype":
        entry["dtype"] = data.draw(st.sampled_from([*tile_format.DTYPES, "BF16", "", 7, None]))
    elif where == "more":
        entry["more"] = 1
    else:
        index = data.draw(st.integers(0, len(entry[where]) - 1))
        entry[where][index] = data.draw(WILD)
    text = json.dumps(header).encode()
    text += b" " * (-(8 + len(text)) % tile_format.ALIGNMENT)
    tile = len(text).to_bytes(8, "little") + text + template.tile[8 + length :]
    read(template, tmp_path / "map", tile=tile)


@HOSTILE
@given(data=st.data())
def test_values_of_a_layer(template: Template, tmp_path: Path, data: st.DataObject) -> None:
    """The layout is right, the content is not: as a broken or hostile compiler would write it."""
    arrays = dict(template.arrays)
    for name in data.draw(st.lists(st.sampled_from(sorted(arrays)), min_size=1, max_size=3)):
        array = np.array(arrays[name])
        if array.size == 0:
            continue
        raw = array.reshape(-1).view(np.uint8)
        size = array.dtype.itemsize
        for place in data.draw(st.lists(st.integers(0, array.size - 1), max_size=5)):
            raw[size * place : size * (place + 1)] = list(
                data.draw(st.binary(min_size=size, max_size=size))
            )
        arrays[name] = array
    read(template, tmp_path / "map", tile=tile_format.encode(arrays))


REPLACEMENTS = st.one_of(
    WILD,
    st.none(),
    st.booleans(),
    st.floats(),
    st.text(max_size=20),
    st.sampled_from(
        [
            "../../etc/passwd",
            "/etc/passwd",
            "tiles/../x.tile",
            "tiles/a\n.tile",
            "tiles/.tile",
            "\0",
        ]
    ),
    st.lists(st.integers(), max_size=5),
    st.dictionaries(st.text(max_size=5), st.integers(), max_size=3),
)


@HOSTILE
@given(data=st.data())
def test_values_of_a_manifest(template: Template, tmp_path: Path, data: st.DataObject) -> None:
    table = json.loads(template.manifest)
    for _ in range(data.draw(st.integers(1, 3))):
        *way, last = data.draw(st.sampled_from(template.places))
        holder = table
        try:
            for key in way:
                holder = holder[key]
            old = holder[last]
        except (KeyError, IndexError, TypeError):
            continue  # it has gone with an earlier change
        if data.draw(st.booleans()):
            holder[last] = data.draw(REPLACEMENTS)
        elif isinstance(holder, dict):
            del holder[last]
        else:
            holder.append(old)
    read(template, tmp_path / "map", manifest=json.dumps(table).encode())


@HOSTILE
@given(edits=EDITS, length=st.integers(0, 2**31))
def test_bytes_of_a_manifest(
    template: Template, tmp_path: Path, edits: list[tuple[int, int]], length: int
) -> None:
    cut = template.manifest[: 1 + length % len(template.manifest)]
    read(template, tmp_path / "map", manifest=spoil(cut, edits))


def test_a_deeply_nested_manifest(template: Template, tmp_path: Path) -> None:
    for text in (
        b"[" * 200_000,
        b'{"format":' * 100_000,
        b'{"a":' + b"[" * 50_000 + b"]" * 50_000 + b"}",
    ):
        assert not read(template, tmp_path / "map", manifest=text)
