# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.config.lines import ThreeViewConfig
from edge.geometry import se3
from edge.lines import kernels_threeview
from edge.lines.line import Segments, segments_between
from edge.lines.threeview import Drawn, Posed, drawn, match
from edge.types import F64, I32, Mat4
from tests.edge.lines.line_scenes import CAMERA, ends_before, project, viewpoint

N_LINES = 30
DEPTHS = (0.5, 8.0)


def posed(
    rng: np.random.Generator, T: Mat4, pairs: F64, noise_px: float, shades: F64
) -> tuple[Posed, I32]:
    """A view of all lines in some order, and which line each segment shows."""
    order = rng.permutation(len(pairs))
    pixels = project(se3.transform(T, pairs[order].reshape(-1, 3))).reshape(-1, 4)
    segments = segments_between(pixels + rng.normal(0.0, noise_px, pixels.shape), 0.2)
    grey = np.repeat(shades[order, :, None], kernels_threeview.PROFILE, axis=2).astype(np.float32)
    return Posed(Drawn(segments, grey), T), order.astype(np.int32)


def views(seed: int, noise_px: float = 0.2) -> tuple[list[Posed], list[I32]]:
    rng = np.random.default_rng(seed)
    T = viewpoint(rng)
    poses = [se3.exp([0.1 * k, 0.05 * (k % 3), 0, 0, 0.02 * k, 0]) @ T for k in range(5)]
    pairs = ends_before(rng, T, N_LINES, flat=False)
    shades = rng.uniform(40.0, 220.0, (N_LINES, 2))
    made = [posed(rng, T_k, pairs, noise_px, shades) for T_k in poses]
    return [view for view, _ in made], [order for _, order in made]


@pytest.mark.parametrize("seed", range(4))
def test_matched_segments_show_the_same_line(seed: int) -> None:
    seen, orders = views(seed)
    best, score = match(seen[2], [seen[k] for k in (0, 1, 3, 4)], CAMERA, DEPTHS, ThreeViewConfig())
    assert np.count_nonzero(score) >= 0.8 * N_LINES
    right, wrong = 0, 0
    for j, k in enumerate((0, 1, 3, 4)):
        found = best[:, j] >= 0
        same = orders[k][best[found, j]] == orders[2][found]
        right, wrong = right + np.count_nonzero(same), wrong + np.count_nonzero(~same)
    assert right > 60
    assert wrong <= 0.05 * right


def test_the_tensor_transfers_points_through_lines_to_where_they_are_seen() -> None:
    rng = np.random.default_rng(5)
    second, third = (se3.exp(rng.normal(0.0, 0.3, 6))[:3] for _ in range(2))
    tensor = np.empty((3, 3, 3))
    kernels_threeview.tensor(second, third, tensor)
    for _ in range(20):
        p, q = rng.uniform([-1, -1, 2], [1, 1, 5], (2, 3))
        x = p / p[2]
        line = np.cross(second[:, :3] @ p + second[:, 3], second[:, :3] @ q + second[:, 3])
        seen = np.einsum("i,j,ijk->k", x, line, tensor)
        true = third[:, :3] @ p + third[:, 3]
        assert np.allclose(seen / seen[2], true / true[2], atol=1e-9)


def test_two_views_alone_match_nothing() -> None:
    seen, _ = views(0)
    best, score = match(seen[2], [seen[3]], CAMERA, DEPTHS, ThreeViewConfig())
    assert not score.any()
    assert np.all(best == -1)
    nothing = Posed(
        Drawn(Segments(*(a[:0] for a in seen[0].drawn.segments)), seen[0].drawn.grey[:0]),
        seen[0].T_cam_lines,
    )
    best, score = match(seen[2], [seen[3], nothing], CAMERA, DEPTHS, ThreeViewConfig())
    assert not score.any()


def test_what_has_the_brighter_side_on_the_other_hand_is_another_line() -> None:
    seen, _ = views(1)
    turned = [
        view._replace(
            drawn=view.drawn._replace(
                segments=view.drawn.segments._replace(direction=-view.drawn.segments.direction)
            )
        )
        for view in seen
    ]
    best, _ = match(
        seen[2], [seen[0], seen[1], seen[3], seen[4]], CAMERA, DEPTHS, ThreeViewConfig()
    )
    others, _ = match(
        seen[2], [turned[0], turned[1], turned[3], turned[4]], CAMERA, DEPTHS, ThreeViewConfig()
    )
    assert np.count_nonzero(others >= 0) < 0.1 * np.count_nonzero(best >= 0)


def test_other_sides_make_another_line() -> None:
    seen, _ = views(2)
    dark = [
        view._replace(drawn=view.drawn._replace(grey=view.drawn.grey * np.float32(0.2)))
        for view in seen
    ]
    _, score = match(seen[2], [dark[0], dark[1], dark[3]], CAMERA, DEPTHS, ThreeViewConfig())
    assert np.count_nonzero(score) < 0.3 * N_LINES


def test_looks_do_not_depend_on_the_exposure() -> None:
    image = np.full((120, 160), 60, np.uint8)
    image[:, 80:] = 120
    segments = segments_between([[79.5, 10.0, 79.5, 100.0]], 0.1)
    brighter = drawn((1.5 * image).astype(np.uint8), segments)
    assert np.allclose(brighter.grey, drawn(image, segments).grey, atol=1.0)
    left, right = drawn(image, segments).grey[0]
    assert abs(left[-1] - right[-1]) == pytest.approx(60 * 128 / 90, abs=1.0)
