# SPDX-License-Identifier: Apache-2.0
"""Train the vocabulary that mapvo ships, on simulated rooms and drawn pictures alone.

    python -m tools.train_vocabulary --out edge/relocalise/vocabulary.tile

The same options give the same file on one machine and one set of versions. Every map names the
vocabulary that it was built with, so a new one makes all maps be built again.
"""

import argparse
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from pathlib import Path

import cv2
import numpy as np

from edge.config.features import OrbConfig
from edge.geometry.camera import CameraModel
from edge.relocalise.features import OrbExtractor
from edge.types import U8
from maps.vocabulary_training import train
from tools.simworld.paths import make_path
from tools.simworld.pictures import document, notes, photograph, poster, screen, spines, whiteboard
from tools.simworld.renderer import Renderer
from tools.simworld.rooms import make_room
from tools.simworld.sensor import Sensor, capture

CAMERA = CameraModel(640, 480, 460.0, 460.0, 319.5, 239.5)
SECONDS_PER_ROOM = 24.0
PICTURES = (document, notes, photograph, poster, screen, spines, whiteboard)


def room_images(seed: int, count: int) -> Iterator[U8]:
    """Grey images of a walk through one room, with a camera of its own faults."""
    rng = np.random.default_rng([seed, 5])
    style = "corridor" if seed % 6 == 5 else "office"
    world = make_room(1000 + seed, style)
    kind = "forward" if style == "corridor" else "walk"
    path = make_path(world, 7000 + seed, SECONDS_PER_ROOM, 20.0, kind)
    sensor = Sensor(
        noise_grey=float(rng.uniform(0.0, 6.0)),
        vignette=float(rng.uniform(0.0, 0.4)),
        exposure="sine",
        exposure_stops=0.7,
        blur_ms=float(rng.choice([0.0, 0.0, 12.0])),
        blur_samples=3,
        seed=seed,
    )
    renderer = Renderer(world, CAMERA)
    for index in np.linspace(0, len(path.t_ns) - 1, count).astype(int):
        yield cv2.cvtColor(capture(renderer, path, int(index), sensor).bgr, cv2.COLOR_BGR2GRAY)


def drawn_image(seed: int) -> U8:
    """A grey picture of things that no room has: noise of all sizes, polygons, pages, print."""
    rng = np.random.default_rng([seed, 6])
    image = np.full((480, 640), 128.0, np.float32)
    for cell in (3, 6, 12, 30, 80, 200):
        noise = rng.normal(0.0, 1.0, (480 // cell + 3, 640 // cell + 3)).astype(np.float32)
        strength = rng.uniform(1.0, 20.0) * (cell / 60.0) ** 0.3
        image += strength * cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC)
    for _ in range(int(rng.integers(30, 150))):
        _draw_polygon(image, rng)
    for _ in range(int(rng.integers(0, 6))):
        _paste_picture(image, rng)
    blurred = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.4, 1.8)))
    noisy = blurred + rng.normal(0.0, rng.uniform(0.5, 4.0), image.shape)
    drawn: U8 = np.clip(noisy, 0, 255).astype(np.uint8)
    return drawn


def _draw_polygon(image: np.ndarray, rng: np.random.Generator) -> None:
    centre = rng.uniform(0.0, 1.0, 2) * (640.0, 480.0)
    radius = np.exp(rng.uniform(1.5, 4.8))
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, int(rng.integers(3, 8))))
    flatness = rng.uniform(0.3, 1.0)
    corners = centre + radius * np.stack((np.cos(angles), flatness * np.sin(angles)), axis=1)
    mask = np.zeros(image.shape, np.uint8)
    cv2.fillPoly(mask, [np.round(corners).astype(np.int32)], 1)
    texture = 0.4 * (image[mask > 0] - 128.0) if rng.random() < 0.4 else 0.0
    image[mask > 0] = rng.uniform(15.0, 240.0) + texture


def _paste_picture(image: np.ndarray, rng: np.random.Generator) -> None:
    """Put a picture of the simulated rooms somewhere, seen askew."""
    make = PICTURES[int(rng.integers(len(PICTURES)))]
    b, g, r = (float(value) for value in rng.uniform(60.0, 230.0, 3))
    picture = cv2.cvtColor(make(rng, (512, 512), (b, g, r)), cv2.COLOR_BGR2GRAY).astype(np.float32)
    centre = rng.uniform(0.1, 0.9, 2) * (640.0, 480.0)
    size = rng.uniform(50.0, 200.0)
    square = size * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * rng.uniform(0.6, 1.0, (4, 2))
    corners = (centre + square).astype(np.float32)
    h, w = picture.shape
    source = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
    warp = cv2.getPerspectiveTransform(source, corners)
    small = cv2.warpPerspective(picture, warp, (640, 480), flags=cv2.INTER_AREA)
    mask = cv2.warpPerspective(np.ones_like(picture), warp, (640, 480)) > 0.99
    image[mask] = small[mask]


def main() -> int:
    """Train, and say what came out."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.add_argument("--rooms", type=int, default=30, metavar="N")
    parser.add_argument("--images-per-room", type=int, default=10, metavar="N")
    parser.add_argument("--drawn", type=int, default=300, metavar="N")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="threads")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    extractor = OrbExtractor(OrbConfig())
    descriptors, images = [], []
    with ThreadPoolExecutor(options.workers) as pool:
        rooms = pool.map(
            lambda seed: list(room_images(seed, options.images_per_room)), range(options.rooms)
        )
        drawn = pool.map(lambda seed: [drawn_image(seed)], range(options.drawn))
        for number, image in enumerate(chain.from_iterable(chain(rooms, drawn))):
            found = extractor.extract(image, CAMERA).descriptors
            descriptors.append(found)
            images.append(np.full(len(found), number, np.int32))
            if sys.stderr.isatty():
                print(f"\rimages {number + 1}", end="", file=sys.stderr, flush=True)
    origin = f"{options.rooms} simulated rooms, {options.drawn} drawn pictures"
    data = train(
        np.concatenate(descriptors), np.concatenate(images), seed=options.seed, origin=origin
    )
    options.out.write_bytes(data)
    print(f"{options.out}: {len(data)} bytes from {len(images)} images, {origin}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
