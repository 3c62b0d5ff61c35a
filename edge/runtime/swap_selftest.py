# SPDX-License-Identifier: Apache-2.0
"""Whether a map can be localised in: some of its keyframes are hidden and have to be found."""

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.config.tiles import TilesConfig
from edge.errors import TileError
from edge.relocalise.features import Features
from edge.relocalise.relocaliser import Relocaliser
from edge.store.bundle import HeldOut
from edge.tiles.index import BowVector
from edge.tiles.reader import KeyframeFeatures, Map
from edge.types import F32, I32, Frame, Query

MOST_HIDDEN = 24  # enough to tell 80 % from 50 %; a second of work
HIDE_EVERY = 5  # of the keyframes; the others have to do without them


class HeldOutResult(NamedTuple):
    """How many hidden keyframes were tried, found where they are, and found elsewhere."""

    tried: int
    found: int
    wrong: int


def choose_held_out(n_keyframes: int) -> list[int]:
    """Keyframes to hide, spread evenly over the map."""
    step = max(HIDE_EVERY, -(-n_keyframes // MOST_HIDDEN))
    return list(range(step // 2, n_keyframes, step))


def find_held_out(
    map_: Map, keyframes: Sequence[int], relocalise: RelocaliseConfig, tiles: TilesConfig
) -> HeldOutResult:
    """Localise each of the keyframes in the map without all of them."""
    if any(k >= map_.n_keyframes for k in keyframes):
        raise TileError(f"{map_.folder}: has not the keyframes that should be found in it")
    rest = cast(Map, _MapWithout(map_, frozenset(keyframes)))
    relocalisers: dict[int, Relocaliser] = {}
    found = wrong = 0
    for k in keyframes:
        number = int(map_.keyframe_camera[k])
        if number not in relocalisers:
            relocalisers[number] = Relocaliser(rest, map_.cameras[number], relocalise)
        attempt = relocalisers[number].attempt(_features(map_.features(k)), _query(k))
        if attempt.reason != "ok" or attempt.solution is None:
            continue
        off_m = np.linalg.norm(attempt.solution.T_map_cam[:3, 3] - map_.T_map_cam[k, :3, 3])
        right = off_m <= tiles.self_test_depth_share * attempt.solution.depth_m
        found, wrong = found + int(right), wrong + int(not right)
    return HeldOutResult(len(keyframes), found, wrong)


def check_held_out(
    map_: Map, held_out: HeldOut, relocalise: RelocaliseConfig, tiles: TilesConfig
) -> HeldOutResult:
    """TileError unless nearly as many keyframes are found as on the workstation."""
    result = find_held_out(map_, held_out.keyframes, relocalise, tiles)
    if result.found < tiles.self_test_share * held_out.found or result.wrong > 1:
        raise TileError(
            f"{map_.folder.name}: self-test failed: {result.found} of {result.tried} keyframes "
            f"found ({held_out.found} where the bundle was made), {result.wrong} at a wrong "
            "place; build the map with this version of mapvo"
        )
    return result


_NOTHING = KeyframeFeatures(
    np.empty((0, 2), np.float32),
    np.empty((0, 32), np.uint8),
    np.empty(0, np.uint8),
    np.empty(0, np.float32),
    np.empty(0, np.int32),
)
for _array in _NOTHING:
    _array.flags.writeable = False  # as a map's are: to Numba others are another type


class _MapWithout:
    """A map that shows nothing of some keyframes, but for their number."""

    def __init__(self, map_: Map, hidden: frozenset[int]) -> None:
        self._map = map_
        self._hidden = hidden
        self._hidden_array = np.array(sorted(hidden), np.int32)

    def __getattr__(self, name: str) -> object:
        return getattr(self._map, name)

    @property
    def bow(self) -> "_MapWithout":
        return self

    def query(self, vector: BowVector, k: int) -> tuple[I32, F32]:
        ids, scores = self._map.bow.query(vector, k + len(self._hidden))
        shown = ~np.isin(ids, self._hidden_array)
        return ids[shown][:k], scores[shown][:k]

    def covisible(self, k: int) -> tuple[I32, I32]:
        ids, shared = self._map.covisible(k)
        shown = ~np.isin(ids, self._hidden_array)
        return ids[shown], shared[shown]

    def features(self, k: int) -> KeyframeFeatures:
        return _NOTHING if k in self._hidden else self._map.features(k)


def _features(stored: KeyframeFeatures) -> Features:
    # Copies, which may be written to as an image's own: else kernels were compiled for them alone.
    pixels = stored.pixels.copy()
    octave, angle_rad = stored.octave.copy(), stored.angle_rad.copy()
    return Features(pixels, stored.descriptors.copy(), octave, angle_rad, pixels)


def _query(k: int) -> Query:
    return Query(Frame(k, 0, np.zeros((1, 1), np.uint8)))  # found by its features alone
