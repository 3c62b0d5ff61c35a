# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.relocalise import kernels_match as kernels


def descriptors(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.integers(0, 2**64, (n, 4), dtype=np.uint64)


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.bitwise_count(a[:, None] ^ b[None]).sum(axis=2)


def test_match_all_is_brute_force() -> None:
    rng = np.random.default_rng(0)
    query, rows = descriptors(rng, 60), descriptors(rng, 300)
    point = rng.integers(0, 90, 300).astype(np.int32)
    best, distance = np.empty((60, 3), np.int32), np.empty((60, 3), np.int32)
    work, row_best = np.empty(300, np.int32), np.empty(300, np.int32)
    columns = np.ascontiguousarray(rows.T)
    kernels.match_all(query, columns, point, 256, work, row_best, best, distance)
    D = distances(query, rows)
    np.testing.assert_array_equal(row_best, np.argmin(D, axis=0))
    for i in range(60):
        seen: list[int] = []
        for j in np.argsort(D[i], kind="stable"):
            if point[j] not in point[seen]:
                seen.append(int(j))
        assert best[i].tolist() == seen[:3]
        assert distance[i].tolist() == D[i, seen[:3]].tolist()


def test_match_all_with_one_point_has_no_rivals() -> None:
    rng = np.random.default_rng(1)
    query, rows = descriptors(rng, 5), descriptors(rng, 8)
    best, distance = np.empty((5, 3), np.int32), np.empty((5, 3), np.int32)
    work, row_best = np.empty(8, np.int32), np.empty(8, np.int32)
    columns = np.ascontiguousarray(rows.T)
    point = np.zeros(8, np.int32)
    kernels.match_all(query, columns, point, 256, work, row_best, best, distance)
    assert np.all(best[:, 1:] == -1)
    assert np.all(distance[:, 1:] == 256)


def test_windows_find_what_brute_force_finds() -> None:
    rng = np.random.default_rng(2)
    n, m, cell, columns, rows = 400, 120, 24, 27, 20
    pixels = rng.uniform((-5, -5), (650, 485), (n, 2)).astype(np.float32)
    octave = rng.integers(0, 8, n).astype(np.uint8)
    query, wanted = descriptors(rng, n), descriptors(rng, m)
    centre = rng.uniform((0, 0), (640, 480), (m, 2))
    radius = rng.uniform(0.0, 60.0, m) * (rng.random(m) < 0.9)
    level = rng.uniform(0, 7, m).astype(np.float32)
    start, member = np.empty(columns * rows + 1, np.int32), np.empty(n, np.int32)
    kernels.sort_into_cells(pixels, cell, columns, rows, start, member)
    assert sorted(member.tolist()) == list(range(n))
    out, distance, rival = np.empty((3, m), np.int32)
    kernels.match_windows(
        query, pixels, octave, start, member, cell, columns, rows,
        wanted, centre, radius, level, np.float32(1.6), out, distance, rival,
    )  # fmt: skip
    D = distances(wanted, query)
    for k in range(m):
        inside = np.hypot(*(pixels - centre[k]).T) <= radius[k]
        inside &= np.abs(octave - level[k]) <= 1.6
        inside &= radius[k] > 0.0
        if not inside.any():
            assert out[k] == -1
            assert distance[k] == 256
            continue
        assert distance[k] == D[k, inside].min()
        assert D[k, out[k]] == distance[k]
        apart = inside & (np.hypot(*(pixels - pixels[out[k]]).T) > 3.0)
        # A rival seen before the best one may have been nearer to an older best: never too low.
        assert rival[k] >= (D[k, apart].min() if apart.any() else 256)
