# SPDX-License-Identifier: Apache-2.0
"""Real things, cut out of a video and of photos where a trained model found them most surely."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from edge.segmenter.model import Model
from edge.types import U8, Mask
from tools.bench.changes_scene import Cutout, Scene

_OF_VIDEO = {"cup": False, "book": True}  # whether they lie flat
_OF_PHOTOS = {"bottle": 0.26, "potted plant": 0.3, "microwave": 0.26, "tv": 0.28}  # [m]
_EVERY, _LEAST_SCORE = 10, 0.55
_LEAST_PX, _LEAST_PHOTO_PX = 1200, 400
_BORDER_PX = 6
_ZOOMS = (1, 2, 3)  # parts that a side of a photo is cut into: a model sees small things badly
_LARGEST_M = 0.6
_FLAT_M_PER_PX = 0.0015


class _Found(NamedTuple):
    score: float
    rgb: U8  # all of the image
    mask: Mask
    image: int


def cut_out(scene: Scene, photos: Path | None, model: Model) -> list[Cutout]:
    """Of each kind the surest of the video and of each folder of photos, the surest first."""
    found = [(f.score, _of_video(scene, label, f)) for label, f in _in_video(scene, model).items()]
    for folder in sorted(photos.iterdir()) if photos else ():
        for label, f in _in_photos(sorted(folder.glob("*.jpg")), model).items():
            found.append((f.score, _of_photo(label, f)))
    found = [(score, thing) for score, thing in found if thing is not None]
    return [thing for _, thing in sorted(found, key=lambda pair: -pair[0]) if thing is not None]


def _in_video(scene: Scene, model: Model) -> dict[str, _Found]:
    recording = scene.recording
    images = ((i, recording.colour(i)) for i in range(0, len(recording), _EVERY))
    shown = ((i, rgb) for i, rgb in images if rgb is not None)
    return _surest(shown, model, list(_OF_VIDEO), _LEAST_PX)


def _in_photos(files: Sequence[Path], model: Model) -> dict[str, _Found]:
    return _surest(_parts(files), model, list(_OF_PHOTOS), _LEAST_PHOTO_PX)


def _parts(files: Sequence[Path]) -> Iterator[tuple[int, U8]]:
    for number, file in enumerate(files):
        bgr = cv2.imread(str(file))
        if bgr is None:
            continue
        for zoom in _ZOOMS:
            h, w = (side // zoom for side in bgr.shape[:2])
            for top in range(0, bgr.shape[0] - h + 1, h // 4):
                for left in range(0, bgr.shape[1] - w + 1, w // 4):
                    part = bgr[top : top + h, left : left + w, ::-1]
                    yield number, np.ascontiguousarray(part)


def _surest(
    images: Iterator[tuple[int, U8]], model: Model, kinds: Sequence[str], least_px: int
) -> dict[str, _Found]:
    best: dict[str, _Found] = {}
    for i, rgb in images:
        seen = model.segment(rgb)
        for label, score, mask in zip(seen.classes, seen.scores, seen.masks, strict=True):
            name = model.contract.names[int(label)]
            least = max(_LEAST_SCORE, best[name].score if name in best else 0.0)
            if name in kinds and score > least and _is_whole(mask, rgb, least_px):
                best[name] = _Found(float(score), rgb, mask, i)
    return best


def _is_whole(mask: Mask, rgb: U8, least_px: int) -> bool:
    (h, w), (height, width) = mask.inside.shape, rgb.shape[:2]
    inner = min(mask.left, mask.top) > _BORDER_PX and mask.left + w < width - _BORDER_PX
    return bool(inner and mask.top + h < height - _BORDER_PX and mask.inside.sum() >= least_px)


def _of_photo(label: str, found: _Found) -> Cutout:
    bgr, alpha = _cut(found)
    h = len(alpha)
    foot = np.array([np.nonzero(alpha)[1].mean(), h - 1.0])
    return Cutout(label, bgr, alpha, foot, np.array([0.0, -1.0]), _OF_PHOTOS[label] / h)


def _of_video(scene: Scene, label: str, found: _Found) -> Cutout | None:
    return (_lay if _OF_VIDEO[label] else _stand)(scene, label, found)


def _cut(found: _Found) -> tuple[U8, U8]:
    mask = found.mask
    h, w = mask.inside.shape
    part = found.rgb[mask.top : mask.top + h, mask.left : mask.left + w, ::-1]
    return np.ascontiguousarray(part), mask.inside.astype(np.uint8) * 255


def _stand(scene: Scene, label: str, found: _Found) -> Cutout | None:
    """A thing that stands upright, as large as the video's depths say."""
    mask, i = found.mask, found.image
    h, w = mask.inside.shape
    pixels, depth = scene.pixels_at(i, scene.xyz)
    at = np.rint(pixels).astype(np.int64) - (mask.left, mask.top)
    inside = (depth > 0.2) & ((at >= 0) & (at < (w, h))).all(axis=1)
    inside[inside] = mask.inside[at[inside, 1], at[inside, 0]]
    if inside.sum() < 20:
        return None
    far = float(np.percentile(depth[inside], 30))  # what lies behind is projected, too
    if max(h, w) * far / scene.camera.fx > _LARGEST_M:
        return None
    front = scene.xyz[inside][np.abs(depth[inside] - far) < 0.1 * far]
    ends, _ = scene.pixels_at(
        i, np.stack([front.mean(axis=0), front.mean(axis=0) + 0.1 * scene.up])
    )
    up = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    bgr, alpha = _cut(found)
    rows, columns = np.nonzero(mask.inside)
    along = np.column_stack([columns, rows]) @ up
    middle = np.array([columns.mean(), rows.mean()])
    foot = middle + (along.min() - middle @ up) * up
    return Cutout(label, bgr, alpha, foot, up, far / scene.camera.fx)


def _lay(scene: Scene, label: str, found: _Found) -> Cutout | None:
    """A thing that lies on the level surface, as it is seen from above."""
    ground = scene.ground_in(found.image)
    rows, columns = np.nonzero(found.mask.inside)
    uv = np.linalg.solve(
        ground,
        np.stack([columns + found.mask.left, rows + found.mask.top, np.ones(len(rows))]),
    )
    uv = uv[:2] / uv[2]
    low, high = uv.min(axis=1), uv.max(axis=1)
    if (high - low).max() > _LARGEST_M:
        return None
    w, h = np.ceil((high - low) / _FLAT_M_PER_PX).astype(int)
    from_above = np.array(
        [[_FLAT_M_PER_PX, 0.0, low[0]], [0.0, _FLAT_M_PER_PX, low[1]], [0.0, 0.0, 1.0]]
    )
    whole = np.zeros(found.rgb.shape[:2], np.uint8)
    whole[rows + found.mask.top, columns + found.mask.left] = 255
    warp, flags = ground @ from_above, cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    bgr = cv2.warpPerspective(np.ascontiguousarray(found.rgb[..., ::-1]), warp, (w, h), flags=flags)
    alpha = cv2.warpPerspective(whole, warp, (w, h), flags=flags)
    foot = np.array([0.5 * w, 0.5 * h])
    return Cutout(label, bgr, alpha, foot, np.array([0.0, -1.0]), _FLAT_M_PER_PX, is_flat=True)
