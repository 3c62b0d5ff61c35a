import os
from pathlib import Path

import numpy as np
import pytest

from edge.errors import BadChecksum, BadMagic, TileError
from edge.tiles import format as tile_format
from edge.tiles.reader import NO_POINT, Map, open_map
from tests.maps.small_map import SmallMap, write_small_map


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> SmallMap:
    return write_small_map(tmp_path_factory.mktemp("maps") / "small")


@pytest.fixture
def spoilable(tmp_path: Path) -> SmallMap:
    return write_small_map(tmp_path / "small")


def keyframe_of_view(opened: Map) -> dict[int, int]:
    """Global keyframe index of each view of the truth."""
    return {int(t_ns) // 1_000_000_000: k for k, t_ns in enumerate(opened.keyframe_t_ns)}


def rewrite(path: Path, **changed: np.ndarray | None) -> None:
    """Replace or take away layers of a tile, and tell the manifest of its new size."""
    arrays, metadata = tile_format.decode(memoryview(path.read_bytes()), str(path))
    for name, array in changed.items():
        if array is None:
            del arrays[name]
        else:
            arrays[name] = array
    old = path.stat().st_size
    path.write_bytes(tile_format.encode(arrays, metadata))
    manifest = path.parents[1] / "manifest.json"
    text = manifest.read_text()
    assert text.count(f'"bytes": {old},') == 1
    manifest.write_text(text.replace(f'"bytes": {old},', f'"bytes": {path.stat().st_size},'))


def first_tile(small: SmallMap) -> Path:
    return small.folder / open_map(small.folder).manifest.tiles[0].path


def test_a_map_in_several_tiles_reads_as_one(small: SmallMap) -> None:
    opened = open_map(small.folder, verify=True)
    assert len(opened.tiles) > 2
    assert opened.n_keyframes == len(small.views)
    assert opened.n_points == len(small.stored.xyz)
    for view, k in keyframe_of_view(opened).items():
        assert np.array_equal(opened.pose(k), small.views[view].T_map_cam)
        assert opened.keyframe_source[k].tolist() == [0, 10 * view]


def test_features_and_their_points_are_those_that_were_written(small: SmallMap) -> None:
    opened = open_map(small.folder)
    for view, k in keyframe_of_view(opened).items():
        features, chosen = opened.features(k), small.stored.features[view]
        described = small.descriptions[view].features
        assert np.array_equal(features.pixels, described.pixels[chosen])
        assert np.array_equal(features.descriptors, described.descriptors[chosen])
        assert np.array_equal(features.octave, described.octave[chosen])
        turn = features.angle_rad - described.angle_rad[chosen]
        off = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
        assert off.max() <= np.pi / 256 + 1e-5
        truth = small.stored.xyz[small.stored.point[view]]
        assert (features.point != NO_POINT).all()
        read = opened.points(features.point)
        assert np.abs(read.xyz - truth).max() < 1e-6  # float32 within a tile of metres


def test_points_know_their_covariance_direction_and_views(small: SmallMap) -> None:
    opened = open_map(small.folder)
    points = opened.points(np.arange(opened.n_points, dtype=np.int32))
    order = [int(np.argmin(np.abs(small.points.xyz - xyz).sum(axis=1))) for xyz in points.xyz]
    truth = small.points.covariance[order]
    assert np.allclose(points.covariance, truth, rtol=1e-4, atol=1e-9)
    assert np.linalg.eigvalsh(points.covariance).min() > 0.0
    assert np.allclose(np.linalg.norm(points.direction, axis=1), 1.0, atol=2e-3)
    assert np.array_equal(points.n_views, np.diff(small.points.offsets)[order])
    centres = np.array([view.T_map_cam[:3, 3] for view in small.views])
    keyframes = keyframe_of_view(opened)
    for index in range(opened.n_points):
        seen_by, feature = opened.point_views(index)
        rows = slice(*small.points.offsets[order[index] : order[index] + 2])
        assert sorted(seen_by) == sorted(keyframes[int(v)] for v in small.points.view[rows])
        for k, row in zip(seen_by, feature, strict=True):
            assert opened.features(int(k)).point[row] == index
        towards = centres[small.points.view[rows]] - points.xyz[index]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        angles = np.arccos(np.clip(towards @ points.direction[index], -1, 1))
        assert angles.max() == pytest.approx(points.half_angle_rad[index], abs=0.05)


def test_points_come_in_the_order_asked_for_across_tiles(small: SmallMap) -> None:
    opened = open_map(small.folder)
    everything = opened.points(np.arange(opened.n_points, dtype=np.int32))
    asked = np.random.default_rng(1).integers(0, opened.n_points, 40).astype(np.int32)
    some = opened.points(asked)
    for all_of, chosen in zip(everything, some, strict=True):
        assert np.array_equal(all_of[asked], chosen)
    assert opened.points(np.empty(0, np.int32)).xyz.shape == (0, 3)


def test_covisible_keyframes_share_as_many_points_as_said(small: SmallMap) -> None:
    opened = open_map(small.folder)
    seen = [set(opened.features(k).point.tolist()) for k in range(opened.n_keyframes)]
    for k in range(opened.n_keyframes):
        others, shared = opened.covisible(k)
        assert list(shared) == sorted(shared, reverse=True)
        assert shared.tolist() == [len(seen[k] & seen[other]) for other in others]
        left_out = set(range(opened.n_keyframes)) - {k} - set(others.tolist())
        assert all(len(seen[k] & seen[other]) < 8 for other in left_out)


def test_depth_samples_come_back(small: SmallMap) -> None:
    opened = open_map(small.folder)
    for view, k in keyframe_of_view(opened).items():
        samples, truth = opened.depth_samples(k), small.descriptions[view].samples
        assert np.array_equal(samples.pixels, truth.pixels)
        assert np.array_equal(samples.inverse_depth, truth.inverse_depth)
        assert np.array_equal(samples.sigma, truth.sigma)


def test_a_keyframe_is_most_like_itself(small: SmallMap) -> None:
    opened = open_map(small.folder)
    for view, k in keyframe_of_view(opened).items():
        ids, scores = opened.bow.query(small.descriptions[view].words, 3)
        assert ids[0] == k
        assert scores[0] == pytest.approx(1.0, abs=1e-5)


def test_indices_beyond_the_map_are_refused(small: SmallMap) -> None:
    opened = open_map(small.folder)
    for k in (-1, opened.n_keyframes):
        with pytest.raises(IndexError):
            opened.features(k)
    for index in (-1, opened.n_points):
        with pytest.raises(IndexError):
            opened.points(np.array([index]))
        with pytest.raises(IndexError):
            opened.point_views(index)


def test_all_that_is_read_is_read_only(small: SmallMap) -> None:
    opened = open_map(small.folder)
    features = opened.features(0)
    for array in (opened.T_map_cam, features.pixels, features.descriptors, features.octave):
        assert not array.flags.writeable


def test_opening_and_reading_changes_no_file(small: SmallMap) -> None:
    before = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in small.folder.rglob("*.*")}
    opened = open_map(small.folder)
    opened.points(opened.features(0).point)
    assert before == {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in small.folder.rglob("*.*")}


def test_unknown_layers_are_ignored(spoilable: SmallMap) -> None:
    rewrite(first_tile(spoilable), **{"lines/segments": np.zeros((3, 6), np.float32)})
    assert open_map(spoilable.folder).n_keyframes == len(spoilable.views)


def test_a_missing_layer_is_named(spoilable: SmallMap) -> None:
    path = first_tile(spoilable)
    rewrite(path, **{"points/sigma": None})
    with pytest.raises(TileError, match=rf"{path}.*points/sigma"):
        open_map(spoilable.folder)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("keyframes/T_map_cam", lambda a: a * 1.01),
        ("keyframes/T_map_cam", lambda a: np.where(a == 0.0, np.nan, a)),
        ("keyframes/T_map_cam", lambda a: a * [[-1.0], [-1.0], [-1.0], [1.0]]),
        ("keyframes/t_ns", lambda a: a[:-1]),
        ("keyframes/camera", lambda a: a + np.uint8(1)),
        ("features/offsets", lambda a: a[::-1].copy()),
        ("features/offsets", lambda a: a + np.uint32(1)),
        ("features/pixels", lambda a: a[:-1]),
        ("features/octave", lambda a: a.astype(np.int16)),
        ("points/view_offsets", lambda a: np.where(a > 0, np.uint32(0xFFFFFFFF), a)),
        ("bow/offsets", lambda a: a[:-1]),
    ],
)
def test_layers_that_do_not_fit_are_refused_when_opened(
    spoilable: SmallMap, name: str, spoil: object
) -> None:
    path = first_tile(spoilable)
    array = tile_format.decode(memoryview(path.read_bytes()), "")[0][name]
    rewrite(path, **{name: spoil(array)})  # type: ignore[operator]
    with pytest.raises(TileError, match=str(spoilable.folder)):
        open_map(spoilable.folder)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("features/point", -2_000_000_000),
        ("features/point", 2_000_000_000),
        ("points/xyz", np.nan),
        ("points/xyz", -np.inf),
        ("points/sigma", np.nan),
        ("points/sigma", np.inf),
    ],
)
def test_wild_numbers_in_a_row_are_refused_when_read(
    spoilable: SmallMap, name: str, value: float
) -> None:
    path = first_tile(spoilable)
    array = tile_format.decode(memoryview(path.read_bytes()), "")[0][name].copy()
    array.reshape(-1)[0] = value
    rewrite(path, **{name: array})
    opened = open_map(spoilable.folder)
    with pytest.raises(TileError, match=str(path)):
        opened.points(opened.features(0).point)


@pytest.mark.parametrize("name", ["links/point", "links/keyframe"])
@pytest.mark.parametrize("column", [0, 1])
def test_a_link_to_nowhere_is_refused_when_followed(
    spoilable: SmallMap, name: str, column: int
) -> None:
    opened = open_map(spoilable.folder)
    tile = next(tile for tile in opened.tiles if len(tile[name]))
    k = next(k for k in range(opened.n_keyframes) if opened._locate(k)[0] == tile.entry.id)
    links = tile[name].copy()
    links[:, column] = 60_000
    rewrite(tile.path, **{name: links})
    opened = open_map(spoilable.folder)
    with pytest.raises(TileError, match=name):
        opened.features(k) if name == "links/point" else opened.covisible(k)


def test_wild_postings_are_left_out(spoilable: SmallMap) -> None:
    path = first_tile(spoilable)
    array = tile_format.decode(memoryview(path.read_bytes()), "")[0]["bow/keyframe"]
    rewrite(path, **{"bow/keyframe": np.full_like(array, 65535)})
    opened = open_map(spoilable.folder)
    scores = opened.bow.scores(spoilable.descriptions[0].words)
    assert np.isfinite(scores).all()
    assert scores[: opened.tiles[0].entry.keyframes].max() == 0.0


def test_one_flipped_bit_anywhere_is_found_by_verification(spoilable: SmallMap) -> None:
    path = first_tile(spoilable)
    data = bytearray(path.read_bytes())
    rng = np.random.default_rng(3)
    for position in rng.integers(0, 8 * len(data), 20):
        spoiled = data.copy()
        spoiled[position // 8] ^= 1 << (position % 8)
        path.write_bytes(spoiled)
        with pytest.raises(BadChecksum, match=str(path)):
            open_map(spoilable.folder, verify=True)


def test_a_truncated_tile_is_refused(spoilable: SmallMap) -> None:
    path = first_tile(spoilable)
    data = path.read_bytes()
    for length in (0, 4, 100, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:length])
        with pytest.raises(TileError, match=rf"{path} has {length} bytes"):
            open_map(spoilable.folder)


def test_what_is_no_regular_file_is_refused_without_waiting(spoilable: SmallMap) -> None:
    path = first_tile(spoilable)
    elsewhere = path.rename(path.with_suffix(".moved"))
    with pytest.raises(TileError, match="cannot be opened"):
        open_map(spoilable.folder)
    os.mkfifo(path)
    with pytest.raises(TileError, match="no regular file"):
        open_map(spoilable.folder)
    path.unlink()
    path.symlink_to(elsewhere)
    with pytest.raises(TileError, match="cannot be opened"):
        open_map(spoilable.folder)


def test_a_folder_that_is_no_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TileError, match="no folder"):
        open_map(tmp_path / "nowhere")
    with pytest.raises(TileError, match="no map"):
        open_map(tmp_path)
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(BadMagic):
        open_map(tmp_path)
    (tmp_path / "manifest.json").write_text("")
    with pytest.raises(TileError, match="empty"):
        open_map(tmp_path)
