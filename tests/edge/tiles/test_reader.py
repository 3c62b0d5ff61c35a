# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.tiles.reader import NO_POINT, Map, open_map
from tests.maps.small_map import SmallMap, write_small_map


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> SmallMap:
    return write_small_map(tmp_path_factory.mktemp("maps") / "small")


def keyframe_of_view(opened: Map) -> dict[int, int]:
    """Global keyframe index of each view of the truth."""
    return {int(t_ns) // 1_000_000_000: k for k, t_ns in enumerate(opened.keyframe_t_ns)}


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


def test_released_tiles_read_the_same_again(small: SmallMap) -> None:
    opened = open_map(small.folder)
    before = [opened.features(k) for k in range(opened.n_keyframes)]
    points = opened.points(np.arange(opened.n_points, dtype=np.int32))
    for tile in opened.tiles:
        tile.release()
    for k, features in enumerate(before):
        assert all(np.array_equal(a, b) for a, b in zip(features, opened.features(k), strict=True))
    again = opened.points(np.arange(opened.n_points, dtype=np.int32))
    assert all(np.array_equal(a, b) for a, b in zip(points, again, strict=True))
