# SPDX-License-Identifier: Apache-2.0
"""Real things put into a real video: cut out where a model found them, set down elsewhere.

Each stands upright on the largest level surface that the video shows, turned to the camera, as
large as it must look from there, and hidden by what the video's own depths (multi-view stereo) say
is before it. Things that only the map's images hold are gone in the drive, and the other way round.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edge.cameras.recording import Recording
from edge.config.segmenter import SegmenterConfig
from edge.segmenter.model import Model
from edge.types import U8
from tools.bench.changes_scene import PLANE_M, Cutout, Scene, Stand

KINDS = ("cup", "bottle", "bowl", "book", "laptop", "vase", "tv", "chair")
EACH = 3  # things that come, and that go
SEEN_PX, SEEN_VIEWS = 200.0, 5  # seen well
_EVERY, _LEAST_SCORE, _LEAST_PX = 10, 0.55, 1200  # of the masks that are cut out
_BORDER_PX = 6
_FREE_M, _APART_M = 0.03, 0.25  # of other surfaces; of other things
_LARGEST_M = 0.6
_ON_EACH_SIDE = 4  # depths of the ground, in each quarter around a foot
_PLACES = 400  # that are tried for each thing


def make_composites(
    scene: Scene, model: Path, folder: Path, ranges: tuple[range, range], seed: int
) -> list[dict[str, Any]]:
    """Write the recordings `map` and `changed` of images `ranges`; what differs between them."""
    rng = np.random.default_rng([seed, 71])
    things = _cut_out(scene, Model(model, SegmenterConfig()))
    stands: list[Stand] = []
    for n in range(2 * EACH):
        stand = _put_down(scene, things[n % len(things)], stands, ranges, rng)
        if stand is not None:
            stands.append(stand)
    truth = []
    gone, new = stands[0::2], stands[1::2]
    counts = [
        _write(scene, folder / name, span, kept)
        for name, span, kept in zip(("map", "changed"), ranges, (gone, new), strict=True)
    ]
    for kind, kept, number in (("removed", gone, 0), ("added", new, 1)):
        for stand, shown in zip(kept, counts[number], strict=True):
            other = _shown(scene, stand, ranges[1 - number])
            truth.append(_row(kind, stand, shown, other))
    (folder / "truth.json").write_text(json.dumps(truth, indent=1))
    return truth


def _cut_out(scene: Scene, model: Model) -> list[Cutout]:
    """Of each kind the surest mask, the surest kind first."""
    names = model.contract.names
    best: dict[str, tuple[float, Cutout]] = {}
    for i in range(0, len(scene.recording), _EVERY):
        rgb = scene.recording.colour(i)
        if rgb is None:
            continue
        seen = model.segment(rgb)
        for label, score, mask in zip(seen.classes, seen.scores, seen.masks, strict=True):
            name = names[int(label)]
            if name not in KINDS or score < max(_LEAST_SCORE, best.get(name, (0.0,))[0]):
                continue
            thing = _cut(scene, i, name, rgb, mask)
            if thing is not None:
                best[name] = (float(score), thing)
    return [thing for _, thing in sorted(best.values(), key=lambda pair: -pair[0])]


def _cut(scene: Scene, i: int, name: str, rgb: U8, mask: Any) -> Cutout | None:
    (h, w), (height, width) = mask.inside.shape, rgb.shape[:2]
    left, top = mask.left, mask.top
    whole = min(left, top) > _BORDER_PX and left + w < width - _BORDER_PX
    if not whole or top + h > height - _BORDER_PX or mask.inside.sum() < _LEAST_PX:
        return None
    pixels, depth = scene.pixels_at(i, scene.xyz)
    at = np.rint(pixels).astype(np.int64) - (left, top)
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
    bgr = np.ascontiguousarray(rgb[top : top + h, left : left + w, ::-1])
    alpha = mask.inside.astype(np.uint8) * 255
    rows, columns = np.nonzero(mask.inside)
    along = np.column_stack([columns, rows]) @ up
    middle = np.array([columns.mean(), rows.mean()])
    foot = middle + (along.min() - middle @ up) * up
    return Cutout(name, bgr, alpha, foot, up, far / scene.camera.fx)


def _put_down(
    scene: Scene,
    thing: Cutout,
    stands: Sequence[Stand],
    ranges: tuple[range, range],
    rng: np.random.Generator,
) -> Stand | None:
    """The place, free and well in view of both parts of the video, that most images show."""
    best: tuple[int, Stand | None] = (0, None)
    for row in rng.integers(len(scene.ground), size=_PLACES).tolist():
        stand = Stand(thing, scene.ground[row], scene.up)
        if any(np.linalg.norm(stand.center - other.center) < _APART_M for other in stands):
            continue
        if not _is_free(scene, stand):
            continue
        views = min(len(_in_view(scene, stand, span[::5])) for span in ranges)
        if views > best[0]:
            best = (views, stand)
    return best[1] if best[0] >= SEEN_VIEWS else None


def _is_free(scene: Scene, stand: Stand) -> bool:
    width, height = stand.size_m
    away = scene.xyz - stand.foot
    high = away @ stand.up
    across = np.linalg.norm(away - high[:, None] * stand.up, axis=1)
    taken = (high > _FREE_M) & (high < height + _FREE_M) & (across < 0.5 * width + _FREE_M)
    ground = (np.abs(high) < PLANE_M) & (across < 0.5 * width + _FREE_M)
    side = np.linalg.svd(stand.up[None])[2][1:] @ away[ground].T > 0.0
    on_all_sides = np.bincount(side[0] + 2 * side[1], minlength=4).min() >= _ON_EACH_SIDE
    return bool(taken.sum() <= 2 and on_all_sides)


def _in_view(scene: Scene, stand: Stand, span: range) -> list[int]:
    """Images that show all of a thing."""
    width, height = stand.size_m
    shown = []
    for i in span:
        (middle,), (depth,) = scene.pixels_at(i, stand.center[None])
        reach = 0.5 * max(width, height) * scene.camera.fx / max(depth, 0.1) + _BORDER_PX
        limit = (scene.camera.width - reach, scene.camera.height - reach)
        if depth > 0.5 and (middle > reach).all() and (middle < limit).all():
            shown.append(i)
    return shown


def _write(scene: Scene, folder: Path, span: range, stands: Sequence[Stand]) -> list[list[int]]:
    """The recording of some images with things in them; pixels of each thing in each image."""
    (folder / "rgb").mkdir(parents=True, exist_ok=True)
    shown: list[list[int]] = [[] for _ in stands]
    for i, bgr in _images(scene.recording, span):
        for number, stand in enumerate(stands):
            bgr, pixels = scene.paint(bgr, i, stand)
            shown[number].append(pixels)
        cv2.imwrite(str(folder / "rgb" / f"{i:06d}.jpg"), bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])
    t_s = scene.recording.t_ns * 1e-9
    lines = [f"{t_s[i]:.6f} rgb/{i:06d}.jpg\n" for i in span]
    (folder / "rgb.txt").write_text("# time_s path\n" + "".join(lines))
    for name in ("camera.toml", "groundtruth.txt"):
        (folder / name).write_bytes((scene.recording.root / name).read_bytes())
    return shown


def _images(recording: Recording, span: range) -> Iterator[tuple[int, U8]]:
    for i in span:
        rgb = recording.colour(i)
        if rgb is not None:
            yield i, np.ascontiguousarray(rgb[:, :, ::-1])


def _shown(scene: Scene, stand: Stand, span: range) -> list[int]:
    """How many pixels of a thing images would show."""
    blank = np.zeros((scene.camera.height, scene.camera.width, 3), np.uint8)
    return [scene.paint(blank, i, stand)[1] for i in span]


def _row(kind: str, stand: Stand, shown: list[int], other: list[int]) -> dict[str, Any]:
    width, height = stand.size_m
    enough = [[n for n in counts if n >= SEEN_PX] for counts in (shown, other)]
    return {
        "kind": kind,
        "label": stand.thing.label,
        "center": stand.center.round(4).tolist(),
        "size": [width, height, width],
        "views": len(enough[0]),
        "median_px": float(np.median(enough[0])) if enough[0] else 0.0,
        "well": min(map(len, enough)) >= SEEN_VIEWS,
    }
