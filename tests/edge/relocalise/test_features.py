# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from edge.config.features import OrbConfig
from edge.geometry.camera import CameraModel
from edge.relocalise import kernels_features as kernels
from edge.relocalise.features import Features, OrbExtractor
from edge.types import U8
from tests.maps.wall_drive import CAMERA, wall

IMAGE = np.ascontiguousarray(wall()[100:580, 100:740])
CAMERA_640 = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)
CIRCLE = [(0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3)]
CIRCLE += [(-dx, -dy) for dx, dy in CIRCLE]


def extract(image: U8, camera: CameraModel = CAMERA_640, **settings: float) -> Features:
    return OrbExtractor(OrbConfig(**settings)).extract(image, camera)  # type: ignore[arg-type]


def scores_of(image: U8) -> U8:
    scores = np.empty_like(image)
    kernels.score_corners(image.reshape(-1), *image.shape, scores.reshape(-1))
    return scores


def test_scores_are_those_of_the_definition() -> None:
    image = IMAGE[:60, :70]
    scores = scores_of(np.ascontiguousarray(image))
    for y in range(kernels.BORDER_PX, 60 - kernels.BORDER_PX):
        for x in range(kernels.BORDER_PX, 70 - kernels.BORDER_PX):
            ring = [int(image[y + dy, x + dx]) - int(image[y, x]) for dx, dy in CIRCLE]
            arcs = [[ring[(start + k) % 16] for k in range(9)] for start in range(16)]
            truth = max(0, *(min(arc) for arc in arcs), *(min(-v for v in arc) for arc in arcs))
            assert scores[y, x] == truth


def test_corners_are_those_that_opencv_finds() -> None:
    threshold = 20
    found = cv2.FastFeatureDetector.create(threshold, nonmaxSuppression=False).detect(IMAGE)
    truth = np.zeros(IMAGE.shape, bool)
    for keypoint in found:
        truth[int(keypoint.pt[1]), int(keypoint.pt[0])] = True
    inside = np.s_[kernels.BORDER_PX : -kernels.BORDER_PX, kernels.BORDER_PX : -kernels.BORDER_PX]
    assert np.array_equal((scores_of(IMAGE) > threshold)[inside], truth[inside])


def test_angles_are_those_of_opencv() -> None:
    keypoints = [k for k in cv2.ORB.create(500).detect(IMAGE) if k.octave == 0]
    xs, ys = np.array([k.pt for k in keypoints], np.int32).T
    angle = np.empty(len(xs), np.float32)
    kernels.orient(IMAGE, np.ascontiguousarray(xs), np.ascontiguousarray(ys), angle)
    off = np.rad2deg(angle) - [k.angle for k in keypoints]
    assert np.abs((off + 180.0) % 360.0 - 180.0).max() < 0.02  # OpenCV's fast arc tangent


def test_as_many_features_as_wanted_spread_over_the_image() -> None:
    features = extract(IMAGE, max_features=1000)
    assert len(features.pixels) == 1000
    cells = (features.pixels // 80).astype(int)
    assert len({tuple(cell) for cell in cells}) >= 46  # of 48; the border takes some of four


def test_a_dim_half_gets_its_share() -> None:
    dim = IMAGE.copy()
    dim[:, 320:] = 100 + dim[:, 320:] // 4
    features = extract(dim, max_features=1000)
    assert np.count_nonzero(features.pixels[:, 0] > 330) > 250
    alone = cv2.ORB.create(1000).detect(dim)
    assert sum(k.pt[0] > 330 for k in alone) < 100  # what sharing is for


def test_all_arrays_agree_and_octaves_are_in_range() -> None:
    features = extract(IMAGE)
    assert {len(array) for array in features} == {len(features.pixels)}
    assert features.descriptors.shape[1] == 32
    assert [array.dtype for array in features] == [
        np.float32,
        np.uint8,
        np.uint8,
        np.float32,
        np.float32,
    ]
    assert features.octave.max() == 7
    assert all(array.flags.c_contiguous for array in features)


def test_the_result_is_the_same_every_time_and_with_any_number_of_threads() -> None:
    before = cv2.getNumThreads()
    try:
        results = []
        for threads in (1, 2, 4):
            cv2.setNumThreads(threads)
            results.append(extract(IMAGE))
    finally:
        cv2.setNumThreads(before)
    for result in results[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(results[0], result, strict=True))


def test_a_read_only_or_sliced_image_gives_the_same() -> None:
    frozen = IMAGE.copy()
    frozen.flags.writeable = False
    framed = np.pad(IMAGE, 5)[5:-5, 5:-5]
    for image in (frozen, framed):
        for a, b in zip(extract(IMAGE), extract(image), strict=True):
            assert np.array_equal(a, b)


@pytest.mark.parametrize("octave", range(8))
def test_corners_of_every_octave_lie_where_they_are(octave: int) -> None:
    # Discs whose size suits the octave, at known places between pixels.
    rng = np.random.default_rng(octave)
    scale = 1.2**octave
    image = np.full((480 * 4, 640 * 4), 60.0, np.float32)
    radius = 2.2 * scale
    grid = np.stack(np.meshgrid(np.arange(60, 600, 60), np.arange(60, 440, 60)), -1).reshape(-1, 2)
    centres = grid + rng.uniform(-3.0, 3.0, grid.shape)
    for x, y in centres:
        at = tuple(np.round(((x + 0.5) * 4 - 0.5, (y + 0.5) * 4 - 0.5) * np.array(16)).astype(int))
        cv2.circle(image, at, round(radius * 4 * 16), 200.0, -1, cv2.LINE_8, 4)
    small = cv2.GaussianBlur(cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA), (3, 3), 0)
    features = extract(small.astype(np.uint8), max_features=3000, min_contrast_grey=20)
    pixels = features.pixels[features.octave == octave]
    off = pixels[:, None] - centres[None]
    nearest = np.argmin(np.linalg.norm(off, axis=2), axis=1)
    off = off[np.arange(len(off)), nearest]
    off = off[np.linalg.norm(off, axis=1) < scale]
    assert len(off) > 20
    # The mean over many discs: a shift of half a pixel of a level would show.
    assert np.abs(off.mean(axis=0)).max() < 0.15 * scale


def test_a_turned_image_keeps_descriptors_and_turns_angles() -> None:
    turned = np.ascontiguousarray(np.rot90(IMAGE, -1))  # clockwise: x, y to h - 1 - y, x
    camera = CameraModel(480, 640, 500.0, 500.0, 240.0, 320.0)
    a = extract(IMAGE, levels=1, max_features=400)
    b = extract(turned, camera, levels=1, max_features=400)
    where = np.stack((479 - a.pixels[:, 1], a.pixels[:, 0]), axis=1)
    distance = np.linalg.norm(where[:, None] - b.pixels[None], axis=2)
    pairs = [(i, int(j)) for i, j in enumerate(distance.argmin(axis=1)) if distance[i, j] < 0.1]
    assert len(pairs) > 250
    i, j = np.array(pairs).T
    bits = np.unpackbits(a.descriptors[i] ^ b.descriptors[j], axis=1).sum(axis=1)
    assert np.median(bits) < 20
    turn = b.angle_rad[j] - a.angle_rad[i] - np.pi / 2
    assert np.median(np.abs((turn + np.pi) % (2 * np.pi) - np.pi)) < 0.01


def test_pixels_are_those_of_the_ideal_camera() -> None:
    lens = CameraModel(
        640, 480, 500.0, 500.0, 320.0, 240.0, "radtan", (-0.28, 0.07, 0.0002, 0.00002)
    )
    features = extract(IMAGE, lens)
    assert np.isfinite(features.pixels).all()
    again = lens.distort_pixels(features.pixels.astype(np.float64))
    assert np.abs(again - features.raw_pixels).max() < 1e-3
    assert np.abs(features.pixels - features.raw_pixels).max() > 10.0


def test_a_blank_or_tiny_image_has_no_features() -> None:
    for image in (np.full((480, 640), 90, np.uint8), np.zeros((30, 30), np.uint8)):
        features = extract(image)
        assert len(features.pixels) == 0
        assert features.descriptors.shape == (0, 32)


def test_a_small_camera_works() -> None:
    features = extract(IMAGE[:240, :320], CAMERA)
    assert len(features.pixels) > 300


def test_the_edge_of_a_black_frame_gives_no_corners() -> None:
    v, u = np.mgrid[:480, :640]
    inside = np.hypot(u - 320, v - 240) < 230
    found = extract(np.where(inside, IMAGE, np.uint8(3)))
    away = np.hypot(*(found.raw_pixels - (320.0, 240.0)).T)
    # Half the patch on the level where the feature was found, and its pixels' size.
    reach = 14.0 * 1.2 ** found.octave.astype(float)
    assert len(away) > 300
    assert np.all(away + reach < 232.0)
