# SPDX-License-Identifier: Apache-2.0
"""A map folder as one object: its tiles joined behind global indices of keyframes and points."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.errors import TileError
from edge.geometry.camera import CameraModel
from edge.tiles import manifest as manifest_format
from edge.tiles.format import Array
from edge.tiles.index import InvertedIndex, InvertedSegment
from edge.tiles.lines import LineTable
from edge.tiles.manifest import Manifest
from edge.tiles.residency import DEFAULT_BYTES, Residency
from edge.tiles.tile import Tile, map_file, verify_checksum
from edge.types import F32, F64, I32, U8, DepthSamples, Mat4, Pinhole

NO_POINT = -1
# A map of so many bytes is checked when it is opened, which takes a board some 0.1 s and tells at
# once what is wrong; each tile of a larger one is when it is visited first.
CHECKED_AT_ONCE_BYTES = 16_000_000
_RAD_PER_ANGLE_STEP = np.float32(2.0 * np.pi / 256.0)
# Of (P, 6) rows l00 l10 l11 l20 l21 l22.
_LOWER = np.tril_indices(3)


class KeyframeFeatures(NamedTuple):
    """The ORB features of one keyframe."""

    pixels: F32  # (n, 2) u, v; ideal, full size
    descriptors: U8  # (n, 32)
    octave: U8  # (n,) pyramid level
    angle_rad: F32  # (n,)
    point: I32  # (n,) global index, NO_POINT where there is none


class MapPoints(NamedTuple):
    """Some points of the map, in the order in which they were asked for."""

    xyz: F64  # (n, 3) in the map frame [m]
    covariance: F64  # (n, 3, 3) [m^2]
    direction: F32  # (n, 3) mean unit vector from the point to the cameras that saw it
    n_views: I32  # (n,) that agree on it, stored or not
    half_angle_rad: F32  # (n,) widest angle between `direction` and a view of it
    parallax_rad: F32  # (n,) widest angle between two views of it; 0 if one view and its depth
    pixel_size: F32  # (n,) length at the point of one pixel of the octave that saw it [m]


class Map:
    """An open map. Everything is read-only and may be read by any thread."""

    def __init__(
        self, folder: Path, manifest: Manifest, tiles: list[Tile], resident_bytes: int
    ) -> None:
        self.folder = folder
        self.manifest = manifest
        self.cameras: tuple[CameraModel, ...] = tuple(c.model() for c in manifest.cameras)
        self._tiles = tiles
        self._levels = manifest.extractor.levels
        self._keyframe_base = _bases([tile.entry.keyframes for tile in tiles])
        self._point_base = _bases([tile.entry.points for tile in tiles])
        self._order = {tile.entry.id: order for order, tile in enumerate(tiles)}
        self.n_keyframes = int(self._keyframe_base[-1])
        self.n_points = int(self._point_base[-1])
        self.T_map_cam: F64 = self._joined("keyframes/T_map_cam")
        self.keyframe_t_ns: NDArray[np.int64] = self._joined("keyframes/t_ns")
        # (K, 2): which of `manifest.sequences`, and the image's index in it.
        self.keyframe_source: I32 = self._joined("keyframes/source")
        self.keyframe_camera: U8 = self._joined("keyframes/camera")
        if self.keyframe_camera.max(initial=0) >= len(self.cameras):
            raise TileError(f"{folder}: a keyframe's camera is not in the manifest; copy it again")
        self._residency = Residency(tiles, resident_bytes)
        self.bow = InvertedIndex(
            [
                InvertedSegment(int(base), tile.entry.keyframes, *_postings(tile))
                for base, tile in zip(self._keyframe_base, tiles, strict=False)
            ],
            self._residency.searched,
        )
        self.lines = LineTable(manifest.tiles, self._keyframe_base, self._residency.visit)
        self._point_links: dict[int, I32] = {}
        self._keyframe_links: dict[int, I32] = {}

    @property
    def camera(self) -> Pinhole:
        """The ideal camera of the first calibration; most maps have but one."""
        return self.cameras[0].pinhole

    def camera_for(self, camera: CameraModel) -> CameraModel:
        """Return the camera to read images of `camera` by: its refined lens, if the map has one."""
        given = manifest_format.camera_entry(camera).id
        for entry in self.manifest.cameras:
            if entry.replaces == given:
                return entry.model()
        return camera

    def features(self, k: int) -> KeyframeFeatures:
        """Return the features of keyframe `k`."""
        order, local = self._locate(k)
        tile = self._residency.visit(order)
        row = tile.row("features/offsets", local)
        pixels, octave = tile["features/pixels"][row], tile["features/octave"][row]
        if not np.isfinite(pixels).all() or octave.max(initial=0) >= self._levels:
            raise tile.damaged("features")
        return KeyframeFeatures(
            pixels=pixels,
            descriptors=tile["features/descriptors"][row],
            octave=octave,
            angle_rad=tile["features/angle"][row] * _RAD_PER_ANGLE_STEP,
            point=self._global_points(order, tile["features/point"][row]),
        )

    def points(self, indices: I32) -> MapPoints:
        """Return the points of the global `indices` (n,)."""
        indices = np.asarray(indices, np.int64)
        if indices.size and not 0 <= indices.min() <= indices.max() < self.n_points:
            raise IndexError(f"the map has points 0 to {self.n_points - 1}")
        out = _empty_points(len(indices))
        owner = np.searchsorted(self._point_base, indices, side="right") - 1
        for order in np.unique(owner):
            chosen = np.flatnonzero(owner == order)
            local = indices[chosen] - self._point_base[order]
            _read_points(self._residency.visit(int(order)), local, chosen, out)
        return out

    def point_views(self, index: int) -> tuple[I32, I32]:
        """Keyframes (n,) that see the point `index`, and which of their features it is (n,)."""
        order = int(np.searchsorted(self._point_base, index, side="right")) - 1
        tile = self._residency.visit(order)
        row = tile.row("points/view_offsets", index - int(self._point_base[order]))
        keyframes = self._global_keyframes(order, tile["points/view_keyframe"][row])
        return keyframes, tile["points/view_feature"][row].astype(np.int32)

    def covisible(self, k: int) -> tuple[I32, I32]:
        """Keyframes (n,) that share points with `k`, and how many (n,); most first."""
        order, local = self._locate(k)
        tile = self._residency.visit(order)
        row = tile.row("covisibility/offsets", local)
        keyframes = self._global_keyframes(order, tile["covisibility/keyframe"][row])
        return keyframes, tile["covisibility/shared"][row].astype(np.int32)

    def depth_samples(self, k: int) -> DepthSamples:
        """Depths that were given with keyframe `k`, at well-spread gradients; maybe none."""
        order, local = self._locate(k)
        tile = self._residency.visit(order)
        row = tile.row("depth/offsets", local)
        samples = DepthSamples(
            tile["depth/pixels"][row], tile["depth/inverse"][row], tile["depth/sigma"][row]
        )
        positive = (samples.inverse_depth > 0.0).all() and (samples.sigma > 0.0).all()
        if not (positive and np.isfinite(samples.pixels).all()):
            raise tile.damaged("depth")
        return samples

    def pose(self, k: int) -> Mat4:
        """T_map_cam (4, 4) of keyframe `k`."""
        T: Mat4 = self.T_map_cam[k]
        return T

    def bound(self, resident_bytes: int) -> None:
        """Let tiles hold no more memory than this from now on."""
        self._residency.bound(resident_bytes)

    def expect(self, place: F64) -> None:
        """Have the tiles around `place` (3,) [m] read from the disk before they are needed."""
        self._residency.expect(place, 0.5 * self.manifest.tile_m)

    @property
    def tiles(self) -> tuple[Tile, ...]:
        """The tiles, in the order of their indices."""
        return tuple(self._tiles)

    def _locate(self, k: int) -> tuple[int, int]:
        if not 0 <= k < self.n_keyframes:
            raise IndexError(f"the map has keyframes 0 to {self.n_keyframes - 1}")
        order = int(np.searchsorted(self._keyframe_base, k, side="right")) - 1
        return order, k - int(self._keyframe_base[order])

    def _joined(self, name: str) -> Array:
        joined = np.concatenate([tile[name] for tile in self._tiles])
        joined.flags.writeable = False
        return joined

    def _global_points(self, order: int, stored: I32) -> I32:
        """Resolve stored references: local, none (-1), or -2 - row in links/point."""
        tile = self._tiles[order]
        links = self._links(order, "links/point", self._point_links, self._point_base)
        if stored.size and not -2 - len(links) < stored.min() <= stored.max() < tile.entry.points:
            raise tile.damaged("features/point")
        points = np.where(stored >= 0, stored + np.int32(self._point_base[order]), NO_POINT)
        linked = np.flatnonzero(stored < NO_POINT)
        points[linked] = links[-2 - stored[linked]]
        return points.astype(np.int32)

    def _global_keyframes(self, order: int, stored: NDArray[np.uint32]) -> I32:
        """Resolve stored references: local, or the count of those + row in links/keyframe."""
        tile = self._tiles[order]
        links = self._links(order, "links/keyframe", self._keyframe_links, self._keyframe_base)
        local = np.arange(tile.entry.keyframes, dtype=np.int32) + int(self._keyframe_base[order])
        table = np.concatenate([local, links])
        if stored.size and stored.max() >= len(table):
            raise tile.damaged("a reference to keyframes")
        resolved: I32 = table[stored]
        return resolved

    def _links(self, order: int, name: str, cache: dict[int, I32], bases: NDArray[np.int64]) -> I32:
        """Global indices (n,) of a tile's references into other tiles."""
        links = cache.get(order)
        if links is None:
            tile = self._tiles[order]
            stored = tile[name].astype(np.int64)
            orders = np.array([self._order.get(int(i), -1) for i in stored[:, 0]], np.int64)
            if np.any(orders < 0) or np.any(stored[:, 1] >= np.diff(bases)[orders]):
                raise tile.damaged(name)
            links = (bases[orders] + stored[:, 1]).astype(np.int32)
            cache[order] = links  # the same whichever thread stores it
        return links


def open_map(
    folder: Path | str, *, verify: bool = False, resident_bytes: int = DEFAULT_BYTES
) -> Map:
    """Open the map in `folder`; TileError says which file is wrong, and how.

    Its tiles are mapped, not read; so much of them stays in memory at most. Their bytes are checked
    against the manifest: at once if the map is small or with `verify`, else tile by tile when they
    are visited for features or points; the word index and the poses are used before.
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    if verify:
        for entry in manifest.files():
            verify_checksum(folder / entry.path, entry)
    return Map(folder, manifest, tiles_of(folder, manifest), resident_bytes)


def tiles_of(folder: Path, manifest: Manifest) -> list[Tile]:
    """The tiles that a manifest names; checked if they are small."""
    words = manifest.vocabulary.words
    tiles = [Tile(folder / entry.path, entry, words) for entry in manifest.tiles]
    if sum(entry.bytes for entry in manifest.tiles) <= CHECKED_AT_ONCE_BYTES:
        for tile in tiles:
            tile.check()
            tile.release(index=True)
    return tiles


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of the map in `folder`."""
    path = folder / manifest_format.FILE_NAME
    if not folder.is_dir():
        raise TileError(f"{folder} is no folder; give a map that mapvo-map built")
    if not path.exists():
        raise TileError(f"{folder} is no map: it has no manifest.json; build one with mapvo-map")
    data = map_file(path)
    if len(data) > manifest_format.MAX_BYTES:
        raise TileError(f"{path} is too large for a manifest; build the map again")
    return manifest_format.decode(bytes(data), path)


def _bases(counts: list[int]) -> NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])


def _postings(tile: Tile) -> tuple[NDArray[np.uint32], NDArray[np.uint16], F32]:
    return tile["bow/offsets"], tile["bow/keyframe"], tile["bow/weight"]


def _empty_points(n: int) -> MapPoints:
    return MapPoints(
        np.empty((n, 3)),
        np.empty((n, 3, 3)),
        np.empty((n, 3), np.float32),
        np.empty(n, np.int32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
    )


def _read_points(
    tile: Tile, local: NDArray[np.int64], rows: NDArray[np.int64], out: MapPoints
) -> None:
    """Copy points of one tile into the rows of `out`."""
    lower = np.zeros((len(local), 3, 3))
    with np.errstate(over="ignore", invalid="ignore"):
        out.xyz[rows] = tile["points/xyz"][local] + np.array(tile.entry.origin_m)
        lower[:, _LOWER[0], _LOWER[1]] = tile["points/sigma"][local]
        out.covariance[rows] = lower @ lower.transpose(0, 2, 1)
    out.direction[rows] = tile["points/direction"][local]
    out.n_views[rows] = tile["points/n_views"][local]
    out.half_angle_rad[rows] = tile["points/half_angle"][local]
    out.parallax_rad[rows] = tile["points/parallax"][local]
    out.pixel_size[rows] = tile["points/pixel_size"][local]
    if not (np.isfinite(out.xyz[rows]).all() and np.isfinite(out.covariance[rows]).all()):
        raise tile.damaged("points")
