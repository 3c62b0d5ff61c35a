# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.learned.contract import CELL_PX
from edge.learned.maps import read_maps

HEIGHT, WIDTH = 64, 96
PEAKS = np.array([(20.3, 30.0), (50.0, 12.6), (70.7, 44.4)])


def heat_of(peaks: np.ndarray, strength: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    heat = np.zeros((HEIGHT, WIDTH))
    for (x, y), s in zip(peaks, strength, strict=True):
        heat += s * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 4.0)
    return heat.astype(np.float32)


def ramps() -> np.ndarray:
    """Descriptors at a quarter of the size that tell their place."""
    v, u = np.mgrid[: HEIGHT // 4, : WIDTH // 4]
    flat = [np.full(u.shape, 100.0)] * 14
    return np.array([4 * u + 1.5, 4 * v + 1.5, *flat], np.float32)


def test_peaks_are_found_between_pixels_strongest_first() -> None:
    heat = heat_of(PEAKS, np.array([1.0, 3.0, 2.0]))
    found = read_maps(heat[None], ramps(), None, 3)
    np.testing.assert_allclose(found.pixels, PEAKS[[1, 2, 0]], atol=0.02)
    assert (np.diff(found.scores) < 0).all()


def test_descriptors_are_those_of_the_place() -> None:
    found = read_maps(heat_of(PEAKS, np.ones(3))[None], ramps(), None, 3)
    place = found.descriptors[:, :2] / found.descriptors[:, 2:3] * 100.0
    np.testing.assert_allclose(place, found.pixels, atol=1.0)  # lengths are taken off first
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-5)


def test_what_is_unreliable_comes_last() -> None:
    worth = np.ones((1, HEIGHT // 8, WIDTH // 8), np.float32)
    worth[0, :, : WIDTH // 16] = 0.01
    found = read_maps(heat_of(PEAKS, np.array([3.0, 1.0, 1.0]))[None], ramps(), worth, 3)
    np.testing.assert_allclose(found.pixels[-1], PEAKS[0], atol=0.1)


def test_logits_of_cells_are_pixels_row_by_row() -> None:
    logits = np.zeros((CELL_PX**2 + 1, HEIGHT // CELL_PX, WIDTH // CELL_PX), np.float32)
    logits[-1] = 8.0  # no key point
    logits[8 * 2 + 5, 3, 7] = 20.0
    found = read_maps(logits, ramps(), None, 10)
    np.testing.assert_allclose(found.pixels, [(7 * 8 + 5, 3 * 8 + 2)], atol=0.5)


def test_an_even_image_has_none() -> None:
    even = np.zeros((1, HEIGHT, WIDTH), np.float32)
    assert len(read_maps(even, ramps(), None, 10).pixels) == 0
