# SPDX-License-Identifier: Apache-2.0
"""manifest.json: what a map folder holds, and the checks before anything of it is believed."""

import math
from hashlib import sha256
from pathlib import Path
from typing import Annotated

import msgspec

from edge.config.features import OrbConfig
from edge.errors import BadChecksum, BadMagic, ConfigError, TileError, UnsupportedVersion
from edge.geometry.camera import CameraModel

FORMAT = "mapvo map"
VERSION = 1
FILE_NAME = "manifest.json"
MAX_BYTES = 1 << 26
MAX_TILES = 1 << 16
MAX_COUNT = (1 << 31) - 2  # indices are int32
_RIGID_TOLERANCE = 1e-6
_NO_SHA256 = b"0" * 64  # stands for a hash where that is computed

_Finite3 = tuple[float, float, float]
_Row = tuple[float, float, float, float]
_Count = Annotated[int, msgspec.Meta(ge=0, le=MAX_COUNT)]
_Sha256 = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z")]
_TilePath = Annotated[str, msgspec.Meta(pattern=r"^tiles/[a-z0-9_]{1,64}\.tile\Z")]
_Scalar = str | int | float | bool | None


class Bounds(msgspec.Struct, frozen=True, kw_only=True):
    """An axis-parallel box in the map frame [m]."""

    min: _Finite3
    max: _Finite3


class Camera(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A calibration in full; `id` is the sha256 of its JSON with an id of zeros.

    A lens that the build has refined stands for the calibration `replaces`: images of that one
    are to be read by this one. The `id` is then that of the refined numbers alone.
    """

    id: _Sha256
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: str
    distortion: list[float]
    replaces: _Sha256 | None = None

    def model(self) -> CameraModel:
        """The camera model of these numbers; ConfigError where they are impossible."""
        return CameraModel(
            self.width,
            self.height,
            self.fx,
            self.fy,
            self.cx,
            self.cy,
            distortion_model=self.distortion_model,
            distortion=tuple(self.distortion),
        )


class VocabularyEntry(msgspec.Struct, frozen=True, kw_only=True):
    """Which vocabulary the words of the inverted index belong to."""

    id: _Sha256
    words: _Count


class TileEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One file: where, how large, its hash, and what it holds."""

    id: Annotated[int, msgspec.Meta(ge=0, lt=MAX_TILES)]  # other tiles refer to it by this
    path: _TilePath
    bytes: Annotated[int, msgspec.Meta(ge=0, le=1 << 40)]
    sha256: _Sha256
    cell: tuple[int, int, int]  # of the grid of `tile_m` metres
    origin_m: _Finite3
    bounds_m: Bounds  # of its points and camera centres
    keyframes: _Count
    points: _Count
    lines: _Count = 0


class Counts(msgspec.Struct, frozen=True, kw_only=True):
    """Sums over the tiles."""

    keyframes: _Count
    points: _Count
    observations: _Count


class MarkerEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A square marker that the map's images show; its z axis comes out of the print."""

    family: Annotated[str, msgspec.Meta(max_length=64)]  # as 4X4_50
    number: Annotated[int, msgspec.Meta(ge=0, le=MAX_COUNT)]
    side: Annotated[float, msgspec.Meta(gt=0.0, lt=1e9)]  # of its black square
    T_map_marker: tuple[_Row, _Row, _Row, _Row]


class LabelsEntry(msgspec.Struct, frozen=True, kw_only=True):
    """Which segmentation model labelled the map."""

    model: str  # name of its file
    sha256: _Sha256  # of its bytes
    names: Annotated[list[str], msgspec.Meta(min_length=1, max_length=32767)]  # of its classes


class WordsFile(msgspec.Struct, frozen=True, kw_only=True):
    """A vocabulary that was trained for one map."""

    path: _TilePath
    bytes: Annotated[int, msgspec.Meta(ge=0, le=1 << 40)]
    sha256: _Sha256
    words: Annotated[int, msgspec.Meta(ge=1, le=1 << 22)]


class LearnedEntry(msgspec.Struct, frozen=True, kw_only=True):
    """Features of a learned model, in tiles of their own for the same keyframes."""

    model: Annotated[str, msgspec.Meta(max_length=255)]  # name of its file
    sha256: _Sha256  # of its bytes: queries use the same
    extractor: OrbConfig  # how many it finds, and what its octaves are
    vocabulary: WordsFile
    counts: Counts
    tiles: Annotated[list[TileEntry], msgspec.Meta(min_length=1, max_length=MAX_TILES)]


class Manifest(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=False):
    """Everything about a map but its arrays. Unknown fields are for newer readers: ignored."""

    format: str
    version: int
    writer: str  # program and version
    opencv: str
    frame: str  # the coordinate frame of poses and points
    metric: bool  # lengths are metres; else an unknown unit
    T_local_map: list[list[float]] | None  # levelled frame, where it was aligned
    tile_m: float
    extractor: OrbConfig
    vocabulary: VocabularyEntry
    cameras: Annotated[list[Camera], msgspec.Meta(min_length=1, max_length=256)]
    sequences: list[str]
    build: dict[str, _Scalar]
    bounds_m: Bounds
    counts: Counts
    tiles: Annotated[list[TileEntry], msgspec.Meta(min_length=1, max_length=MAX_TILES)]
    labels: LabelsEntry | None = None
    markers: list[MarkerEntry] = []
    learned: LearnedEntry | None = None

    def files(self) -> list[TileEntry | WordsFile]:
        """All files of the map but this manifest."""
        if self.learned is None:
            return [*self.tiles]
        return [*self.tiles, *self.learned.tiles, self.learned.vocabulary]


class _Head(msgspec.Struct):
    format: str = ""
    version: int = 0
    checksum: _Sha256 | None = None


def camera_entry(camera: CameraModel) -> Camera:
    """Manifest entry of a camera model."""
    entry = Camera(
        id=_NO_SHA256.decode(),
        width=camera.width,
        height=camera.height,
        fx=float(camera.fx),
        fy=float(camera.fy),
        cx=float(camera.cx),
        cy=float(camera.cy),
        distortion_model=camera.distortion_model,
        distortion=[float(value) for value in camera.distortion],
    )
    return msgspec.structs.replace(entry, id=sha256(msgspec.json.encode(entry)).hexdigest())


def encode(manifest: Manifest) -> bytes:
    """The bytes of manifest.json; their last field tells whether they are still these."""
    text = msgspec.json.format(msgspec.json.encode(manifest), indent=1).removesuffix(b"\n}")
    text += b',\n "checksum": "'
    end = b'"\n}\n'
    return text + sha256(text + _NO_SHA256 + end).hexdigest().encode() + end


def decode(data: bytes, origin: Path) -> Manifest:
    """Return the manifest in `data`; TileError names `origin` and what is wrong in it."""
    try:
        head = msgspec.json.decode(data, type=_Head)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadMagic(f"{origin} is no map's manifest ({error}); give a map folder") from None
    if head.format != FORMAT:
        raise BadMagic(f"{origin} is no map's manifest; give a folder that mapvo-map built")
    if head.version != VERSION:
        raise UnsupportedVersion(
            f"{origin} has format version {head.version}, this program reads {VERSION}; "
            "update it or build the map again"
        )
    if head.checksum is not None:  # a map of an earlier build has none
        own = head.checksum.encode()
        if sha256(data.replace(own, _NO_SHA256)).hexdigest() != head.checksum:
            raise BadChecksum(f"{origin} is damaged or was edited; copy or build the map again")
    try:
        manifest = msgspec.json.decode(data, type=Manifest)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise TileError(f"{origin} is damaged ({error}); copy or build the map again") from None
    if problem := _inconsistency(manifest):
        raise TileError(f"{origin}: {problem}; copy or build the map again")
    return manifest


def _inconsistency(manifest: Manifest) -> str | None:
    """What the types do not say, in words; None if all is well."""
    learned = manifest.learned
    if problem := _inconsistent_tiles(manifest.tiles, manifest.counts):
        return problem
    if learned is not None and (problem := _inconsistent_tiles(learned.tiles, learned.counts)):
        return f"learned: {problem}"
    if len({file.path for file in manifest.files()}) != len(manifest.files()):
        return "two files have one path"
    box = manifest.bounds_m
    if not all(is_length(value) for value in (*box.min, *box.max)):
        return "a bound is no possible length"
    T = manifest.T_local_map
    if T is not None and (len(T) != 4 or any(len(row) != 4 for row in T)):
        return "T_local_map is no 4x4 transform"
    if not all(_is_rigid(marker.T_map_marker) for marker in manifest.markers):
        return "a marker's pose is not rigid"
    try:
        for camera in manifest.cameras:
            camera.model()
    except ConfigError as error:
        return f"camera {error}"
    return None


def _inconsistent_tiles(tiles: list[TileEntry], counts: Counts) -> str | None:
    for what in ("id", "path", "cell"):
        if len({getattr(tile, what) for tile in tiles}) != len(tiles):
            return f"two tiles have one {what}"
    if sum(tile.keyframes for tile in tiles) != counts.keyframes:
        return "the tiles' keyframes do not add up to its count"
    if sum(tile.points for tile in tiles) != counts.points:
        return "the tiles' points do not add up to its count"
    for tile in tiles:
        box = tile.bounds_m
        if not all(is_length(value) for value in (*box.min, *box.max, *tile.origin_m)):
            return "a bound or origin is no possible length"
    return None


def is_length(value: float) -> bool:
    """Whether a map may hold such a coordinate."""
    return math.isfinite(value) and abs(value) < 1e9


def _is_rigid(rows: tuple[_Row, ...]) -> bool:
    R = [row[:3] for row in rows[:3]]
    gram = [sum(a * b for a, b in zip(R[i], R[j], strict=True)) for i in range(3) for j in range(3)]
    near = all(abs(value - (k % 4 == 0)) < _RIGID_TOLERANCE for k, value in enumerate(gram))
    places = all(is_length(row[3]) for row in rows[:3])
    return near and places and rows[3] == (0.0, 0.0, 0.0, 1.0)
