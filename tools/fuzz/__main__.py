# SPDX-License-Identifier: Apache-2.0
"""Coverage-guided search for maps that break their reader.

    pip install atheris
    python -m tools.fuzz tile|manifest|layers [--seconds 60] [libFuzzer options]

`tile` gives the reader any bytes as a tile, `manifest` any bytes as manifest.json, `layers` a map
whose layout is right and whose arrays hold anything. What it finds is written to `crash-*`; a
file given as an option runs that one alone. `tools/check` does not run this: atheris has no wheel
for each machine, and hours find more than seconds. `tests/edge/tiles/test_hostile_maps.py` is the
part that runs with the tests, and `pytest -p tools.fuzz.long` its long form.
"""

import hashlib
import json
import os
import resource
import shutil
import sys
import tempfile
from pathlib import Path

import atheris

# Not the kernels: Numba compiles the byte code that the instrumentation would change.
_READERS = [f"edge.tiles.{name}" for name in ("format", "manifest", "tile", "reader", "index")]
with atheris.instrument_imports(include=_READERS):
    from edge.tiles import format as tile_format
    from edge.tiles import manifest as manifest_format

# Behind the readers: what is imported before them would not be instrumented.
import numpy as np  # noqa: E402

from tests.maps.small_map import write_small_map  # noqa: E402
from tools.fuzz.reading import read_everything  # noqa: E402

MEMORY_BYTES = 3 << 30  # of addresses, most of which the interpreter's libraries take
SECONDS_PER_MAP = 20


class Target:
    """Spoils one map again and again, and reads it."""

    def __init__(self, kind: str, place: Path) -> None:
        self.kind = kind
        self.folder = place / "map"
        write_small_map(self.folder)
        self.manifest_path = self.folder / manifest_format.FILE_NAME
        self.manifest = self.manifest_path.read_bytes()
        self.table = json.loads(self.manifest)
        del self.table["checksum"]  # of what it says by now
        self.tile_path = self.folder / self.table["tiles"][0]["path"]
        self.tile = self.tile_path.read_bytes()
        self.arrays, _ = tile_format.decode(memoryview(self.tile), "template")
        read_everything(self.folder)  # compiles

    def seeds(self, folder: Path) -> None:
        """Write what the search starts from."""
        folder.mkdir()
        whole = {"tile": self.tile, "manifest": self.manifest, "layers": bytes(range(64))}
        (folder / "whole").write_bytes(whole[self.kind])
        if self.kind == "tile":
            few = {name: array[:0] for name, array in self.arrays.items()}
            (folder / "empty").write_bytes(tile_format.encode(few))

    def __call__(self, data: bytes) -> None:
        """Read the map with `data` in it."""
        if self.kind == "manifest":
            self.manifest_path.write_bytes(data)
        else:
            self._write_tile(data if self.kind == "tile" else self._spoilt_layers(data))
        read_everything(self.folder)

    def _write_tile(self, tile: bytes) -> None:
        self.tile_path.unlink()  # the last one may still be mapped
        self.tile_path.write_bytes(tile)
        entry = self.table["tiles"][0]
        entry |= {"bytes": len(tile), "sha256": hashlib.sha256(tile).hexdigest()}
        self.manifest_path.write_text(json.dumps(self.table))

    def _spoilt_layers(self, data: bytes) -> bytes:
        provider = atheris.FuzzedDataProvider(data)
        arrays, names = dict(self.arrays), sorted(self.arrays)
        while provider.remaining_bytes() > 4:
            name = provider.PickValueInList(names)
            array = np.array(arrays[name])
            if array.size:
                size = array.dtype.itemsize
                place = provider.ConsumeIntInRange(0, array.size - 1)
                value = provider.ConsumeBytes(size).ljust(size, b"\xff")
                raw = array.reshape(-1).view(np.uint8)
                raw[size * place : size * (place + 1)] = list(value)
                arrays[name] = array
        return tile_format.encode(arrays)


def main() -> None:
    """Search until something breaks or the time is up."""
    arguments = sys.argv[1:]
    kinds = ("tile", "manifest", "layers")
    if not arguments or arguments[0] not in kinds:
        sys.exit(f"usage: python -m tools.fuzz {'|'.join(kinds)} [--seconds N] [options]")
    options = arguments[1:]
    seconds = "60"
    if options[:1] == ["--seconds"]:
        seconds, options = options[1], options[2:]
    place = Path(tempfile.mkdtemp(prefix="mapvo-fuzz-"))
    target = Target(arguments[0], place)
    target.seeds(place / "seeds")
    limit = _addresses() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    found = [str(place / "seeds")] if all(option.startswith("-") for option in options) else []
    common = [f"-max_total_time={seconds}", f"-timeout={SECONDS_PER_MAP}", "-max_len=600000"]
    atheris.Setup([sys.argv[0], *common, "-rss_limit_mb=0", *options, *found], target)
    try:
        atheris.Fuzz()
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _addresses() -> int:
    """Bytes of addresses that this process has already."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * os.sysconf("SC_PAGE_SIZE")


main()
