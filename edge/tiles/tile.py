# SPDX-License-Identifier: Apache-2.0
"""One tile file, mapped into memory: found, opened, and its layers checked against each other."""

import hashlib
import mmap
import os
import stat
from pathlib import Path

import numpy as np

from edge.errors import BadChecksum, TileError
from edge.tiles import format as tile_format
from edge.tiles.format import Array
from edge.tiles.manifest import MAX_COUNT, TileEntry, WordsFile

PORTRAIT_CELLS = 32  # a side
# Name -> type and shape. A letter stands for a size that must agree within the tile: K keyframes,
# F features, P points, V views of points, C covisible pairs, W words + 1, B postings, D depths,
# L and M links; K1 is K + 1.
LAYERS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "keyframes/T_map_cam": ("F64", ("K", 4, 4)),
    "keyframes/t_ns": ("I64", ("K",)),
    "keyframes/source": ("I32", ("K", 2)),
    "keyframes/camera": ("U8", ("K",)),
    "features/offsets": ("U32", ("K1",)),
    "features/pixels": ("F32", ("F", 2)),
    "features/descriptors": ("U8", ("F", 32)),
    "features/octave": ("U8", ("F",)),
    "features/angle": ("U8", ("F",)),
    "features/point": ("I32", ("F",)),
    "points/xyz": ("F32", ("P", 3)),
    "points/sigma": ("F32", ("P", 6)),
    "points/direction": ("F16", ("P", 3)),
    "points/half_angle": ("F16", ("P",)),
    "points/parallax": ("F16", ("P",)),
    "points/pixel_size": ("F32", ("P",)),
    "points/n_views": ("U16", ("P",)),
    "points/view_offsets": ("U32", ("P1",)),
    "points/view_keyframe": ("U32", ("V",)),
    "points/view_feature": ("U16", ("V",)),
    "covisibility/offsets": ("U32", ("K1",)),
    "covisibility/keyframe": ("U32", ("C",)),
    "covisibility/shared": ("U16", ("C",)),
    "bow/offsets": ("U32", ("W",)),
    "bow/keyframe": ("U16", ("B",)),
    "bow/weight": ("F32", ("B",)),
    "depth/offsets": ("U32", ("K1",)),
    "depth/pixels": ("F32", ("D", 2)),
    "depth/inverse": ("F32", ("D",)),
    "depth/sigma": ("F32", ("D",)),
    "links/keyframe": ("U32", ("L", 2)),
    "links/point": ("U32", ("M", 2)),
}
# Layers that a map may have: of each group all or none.
OPTIONAL_LAYERS: dict[str, dict[str, tuple[str, tuple[str | int, ...]]]] = {
    # Of a segmentation model: what it calls points, saw in keyframes, and objects; numbers of
    # objects O, their places Q and views R, and detections S.
    "labels": {
        "labels/class": ("I16", ("P",)),
        "labels/agreeing": ("U16", ("P",)),
        "labels/seen": ("U16", ("P",)),
        "labels/log_odds": ("F32", ("P",)),
        "labels/detection_offsets": ("U32", ("K1",)),
        "labels/detection_box": ("F32", ("S", 4)),
        "labels/detection_class": ("I16", ("S",)),
        "labels/detection_score": ("F32", ("S",)),
        "labels/object_class": ("I16", ("O",)),
        "labels/object_place_offsets": ("U32", ("O1",)),
        "labels/object_place": ("F32", ("Q", 3)),
        "labels/object_view_offsets": ("U32", ("O1",)),
        "labels/object_view": ("F32", ("R", 3)),
        "labels/object_found": ("BOOL", ("R",)),
    },
    # How objects O looked in images: Z portraits of them, which the group above has views of.
    "portraits": {
        "portraits/offsets": ("U32", ("O1",)),
        "portraits/view": ("U32", ("Z",)),
        "portraits/right": ("F32", ("Z", 3)),
        "portraits/side": ("F32", ("Z",)),
        "portraits/grey": ("U8", ("Z", PORTRAIT_CELLS, PORTRAIT_CELLS)),
    },
    # N lines in space, T times seen by keyframes, X links.
    "lines": {
        "lines/point": ("F32", ("N", 3)),
        "lines/direction": ("F32", ("N", 3)),
        "lines/span": ("F32", ("N", 2)),
        "lines/sigma": ("F32", ("N", 10)),
        "lines/n_views": ("U16", ("N",)),
        "lines/offsets": ("U32", ("K1",)),
        "lines/seen": ("I32", ("T",)),
        "lines/link": ("U32", ("X", 2)),
    },
}
# Row offsets and the layers that they cut.
_OFFSETS = {
    "features/offsets": "F",
    "points/view_offsets": "V",
    "covisibility/offsets": "C",
    "bow/offsets": "B",
    "depth/offsets": "D",
    "labels/detection_offsets": "S",
    "labels/object_place_offsets": "Q",
    "labels/object_view_offsets": "R",
    "portraits/offsets": "Z",
    "lines/offsets": "T",
}
# What only a visit to the place touches. Written last, so that opening touches few pages.
_COLD = ("features", "points", "depth")
_RIGID_TOLERANCE = 1e-6


class Tile:
    """The layers of one tile as read-only views of its file.

    Offsets, sizes and poses are checked here; indices inside a row when the row is read.
    """

    def __init__(self, path: Path, entry: TileEntry, n_words: int) -> None:
        self.path = path
        self.entry = entry
        self._mapped = map_file(path, entry.bytes)
        self.layers, self.metadata = tile_format.decode(memoryview(self._mapped), str(path))
        sizes = _checked_sizes(self.layers, path)
        expected = {"K": entry.keyframes, "P": entry.points, "W": n_words + 1, "N": entry.lines}
        for letter, size in expected.items():
            held = sizes.get(letter, 0)
            if held != size:
                raise TileError(
                    f"{path}: holds {held} where the manifest says {size}; copy it again"
                )
        for name, letter in _OFFSETS.items():
            if name in self.layers:
                _check_offsets(self.layers[name], sizes[letter], f"{path}: {name}")
        _check_poses(self.layers["keyframes/T_map_cam"], path)
        self._checked = False
        self._cold_begin = self._find_cold()
        self.release()  # the kernel maps more than was touched

    def __getitem__(self, name: str) -> Array:
        return self.layers[name]

    def row(self, offsets: str, index: int) -> slice:
        """The rows that belong to `index` in the layers that `offsets` cuts."""
        return slice(int(self.layers[offsets][index]), int(self.layers[offsets][index + 1]))

    def check(self) -> None:
        """BadChecksum unless every byte is that of the manifest; reads the tile the first time."""
        if not self._checked:
            _check_sum(self._mapped, self.path, self.entry)
            self._checked = True

    @property
    def bytes(self) -> int:
        """Memory that the whole tile can take."""
        return len(self._mapped)

    @property
    def index_bytes(self) -> int:
        """Memory of what searches in the whole map read; the place's own layers follow."""
        return min(self._cold_begin, self.bytes)

    @property
    def place_bytes(self) -> int:
        """Memory of what only a visit to the place reads."""
        return self.bytes - self.index_bytes

    def release(self, *, index: bool = False) -> None:
        """Give back the memory of the place, or with `index` all; it is read again when needed."""
        if index or self.place_bytes:
            self._mapped.madvise(mmap.MADV_DONTNEED, 0 if index else self._cold_begin)

    def read_ahead(self) -> None:
        """Have the kernel read the place from the disk, in the background."""
        if self.place_bytes:
            self._mapped.madvise(mmap.MADV_WILLNEED, self._cold_begin)

    def _find_cold(self) -> int:
        """Byte, on the border of a page, from which on there are cold layers only."""
        start = np.frombuffer(self._mapped, np.uint8).ctypes.data
        hot = [self.layers[n] for n in LAYERS if n.endswith("offsets") or _group(n) not in _COLD]
        # Layers of optional groups lie behind, and are cold.
        end = max(array.ctypes.data - start + array.nbytes for array in hot if array.size)
        return -(-end // mmap.PAGESIZE) * mmap.PAGESIZE

    def damaged(self, name: str) -> TileError:
        """The error of a layer whose content is impossible."""
        return TileError(f"{self.path}: {name} is damaged; run mapvo-map verify and copy it again")


def map_file(path: Path, size: int | None = None) -> mmap.mmap:
    """Map a regular file of `size` bytes read-only; TileError if it is anything else."""
    try:
        # O_NONBLOCK: a FIFO in a tile's place must not hang the reader.
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise TileError(f"{path} cannot be opened ({error.strerror}); copy the map again") from None
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise TileError(f"{path} is no regular file; copy the map again")
        if size is not None and status.st_size != size:
            raise TileError(
                f"{path} has {status.st_size} bytes instead of {size}; copy the map again"
            )
        if status.st_size == 0:
            raise TileError(f"{path} is empty; copy the map again")
        return mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:
        raise TileError(f"{path} cannot be mapped ({error}); is memory or space left?") from None
    finally:
        os.close(descriptor)


def verify_checksum(path: Path, entry: TileEntry | WordsFile) -> None:
    """BadChecksum unless the file's bytes are those of the manifest."""
    _check_sum(map_file(path, entry.bytes), path, entry)


def _check_sum(data: mmap.mmap, path: Path, entry: TileEntry | WordsFile) -> None:
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise BadChecksum(f"{path} is damaged: not the bytes that were built; copy the map again")


def _group(name: str) -> str:
    return name.partition("/")[0]


def _checked_sizes(layers: dict[str, Array], path: Path) -> dict[str, int]:
    """Size of each letter of LAYERS, where every layer agrees with it."""
    sizes: dict[str, int] = {}
    for name, (dtype, shape) in _layers_of(layers).items():
        array = layers.get(name)
        if array is None:
            raise TileError(f"{path} has no layer {name}; build the map again")
        agrees = array.dtype == tile_format.DTYPES[dtype] and array.ndim == len(shape)
        for size, expected in zip(array.shape, shape, strict=False):
            if isinstance(expected, str):
                letter, minus = expected[0], len(expected) - 1
                expected = sizes.setdefault(letter, size - minus) + minus
            agrees = agrees and size == expected
        if not agrees:
            raise TileError(
                f"{path}: {name} is {array.dtype}{array.shape}, which does not fit the others; "
                "build the map again"
            )
    if max(sizes.values()) > MAX_COUNT:
        raise TileError(f"{path} holds more than an index can reach; build with smaller tiles")
    return sizes


def _layers_of(layers: dict[str, Array]) -> dict[str, tuple[str, tuple[str | int, ...]]]:
    """The layers that the tile must have: those of all tiles, and of the groups that it has."""
    expected = dict(LAYERS)
    for optional in OPTIONAL_LAYERS.values():
        if not optional.keys().isdisjoint(layers):
            expected |= optional
    return expected


def _check_offsets(offsets: Array, end: int, where: str) -> None:
    if offsets[0] != 0 or offsets[-1] != end or np.any(offsets[1:] < offsets[:-1]):
        raise TileError(f"{where} does not rise from 0 to {end}; copy the map again")


def _check_poses(T_map_cam: Array, path: Path) -> None:
    R = T_map_cam[:, :3, :3]
    # A NaN makes every comparison false, so the test is for what must hold.
    with np.errstate(invalid="ignore", over="ignore"):
        error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3))
        proper = np.linalg.det(R) > 0.0
    rows = T_map_cam[:, 3] == [0.0, 0.0, 0.0, 1.0]
    near = np.abs(T_map_cam[:, :3, 3]) < 1e9
    if not ((error < _RIGID_TOLERANCE).all() and proper.all() and rows.all() and near.all()):
        raise TileError(f"{path}: a keyframe's pose is not rigid; build or copy the map again")
