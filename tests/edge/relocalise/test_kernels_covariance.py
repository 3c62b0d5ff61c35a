# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.relocalise import kernels_covariance as kernels
from edge.relocalise import kernels_pose
from tests.edge.relocalise.room_matches import CAMERA, error, room_matches

CELL_PX, COLUMNS, ROWS, AREA = 80, 8, 6, 2
PLAIN = 1e15


def scatter(room, lens: np.ndarray) -> tuple[np.ndarray, ...]:
    R = np.ascontiguousarray(room.T_map_cam[:3, :3])
    p = np.ascontiguousarray(room.T_map_cam[:3, 3])
    H, b, use = np.empty((6, 6)), np.empty(6), np.ones(len(room.wrong))
    kernels_pose.normal_equations(*room.matches[:4], use, CAMERA, R, p, PLAIN, PLAIN, H, b)
    S, S_depth, S_lens = np.empty((3, 6, 6))
    M = np.empty((COLUMNS * ROWS, 3))
    kernels.common_scatter(
        *room.matches[:4],
        use,
        CAMERA,
        R,
        p,
        CELL_PX,
        COLUMNS,
        ROWS,
        room.matches.axis,
        AREA,
        lens,
        S,
        S_depth,
        S_lens,
        M,
    )
    inverse = np.linalg.inv(H)
    return (*(inverse @ part @ inverse for part in (S, S_depth, S_lens)), M)


def moved(room, shift: np.ndarray) -> np.ndarray:
    """How far the pose moves (6,) when all pixels are shifted by (n, 2)."""
    R = np.ascontiguousarray(room.T_map_cam[:3, :3])
    p = np.ascontiguousarray(room.T_map_cam[:3, 3])
    matches = room.matches._replace(pixels=room.matches.pixels + shift)
    H = np.empty((6, 6))
    use = np.ones(len(room.wrong))
    kernels_pose.refine(*matches[:4], use, CAMERA, R, p, PLAIN, PLAIN, 30, H)
    T = room.T_map_cam.copy()
    T[:3, :3], T[:3, 3] = R, p
    return error(room.T_map_cam, T)


@pytest.fixture
def room():
    return room_matches(0, n=150, sigma_px=1e-3, sigma_along_m=0.0)._replace()


def test_scatter_is_the_covariance_of_shifts_that_cells_share(room) -> None:
    room = room._replace(matches=room.matches._replace(variance=np.ones(150)))
    foreseen, _, _, _ = scatter(room, np.zeros((150, 1, 2)))
    rng = np.random.default_rng(1)
    at = (room.matches.pixels // CELL_PX).astype(int)
    cell = at[:, 1] * COLUMNS + at[:, 0]
    steps = np.array(
        [moved(room, 0.1 * rng.normal(size=(COLUMNS * ROWS, 2))[cell]) for _ in range(300)]
    )
    found = 100.0 * np.cov(steps.T)
    ratio = np.diag(found) / np.diag(foreseen)
    assert np.all((ratio > 0.7) & (ratio < 1.4))  # sigma of a variance of 300: 8 %


def test_a_wrong_lens_moves_the_pose_as_foreseen(room) -> None:
    room = room._replace(matches=room.matches._replace(variance=np.ones(150)))
    ideal = (room.matches.pixels - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx
    shift = 0.3 * CAMERA.fx * 0.01 * ideal * np.sum(ideal**2, axis=1, keepdims=True)
    _, _, foreseen, _ = scatter(room, np.ascontiguousarray(shift[:, None, :]))
    step = moved(room, shift)
    np.testing.assert_allclose(foreseen, np.outer(step, step), atol=0.3 * np.abs(step).max() ** 2)


def test_cell_means_tell_a_shared_shift(room) -> None:
    column = room.matches.pixels[:, :1] // CELL_PX
    shifted = room.matches._replace(pixels=room.matches.pixels - np.where(column == 0, 2.0, 0.0))
    *_, M = scatter(room._replace(matches=shifted), np.zeros((150, 1, 2)))
    used = np.isfinite(M[:, 2])
    left = np.arange(COLUMNS * ROWS) % COLUMNS == 0
    # Points that are 0.1 mm off move single pixels by a tenth.
    assert np.allclose(M[used & left][:, :2], -2.0, atol=0.6)
    assert np.allclose(M[used & ~left][:, :2], 0.0, atol=0.6)


@pytest.mark.parametrize(("size", "expected"), [((100.0, 40.0), 40.0), ((30.0, 90.0), 30.0)])
def test_spread_is_that_of_the_narrow_axis(size: tuple[float, float], expected: float) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.normal(size=(4000, 2)) * size
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    assert kernels.spread(pixels @ turn, np.ones(4000)) == pytest.approx(expected, rel=0.05)
    assert kernels.spread(pixels, np.zeros(4000)) == 0.0
