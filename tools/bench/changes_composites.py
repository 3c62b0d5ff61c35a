# SPDX-License-Identifier: Apache-2.0
"""Real things put into a real video: cut out where a model found them, set down elsewhere.

Each stands or lies on the largest level surface that the video shows, where nothing else is. What
stands is turned to the camera; all are as large as they must look from there, and hidden by what
the video's own depths (multi-view stereo) say is before them. Things that only the map's images
hold are gone in the drive, and the other way round.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from edge.cameras.recording import Recording
from edge.segmenter.model import Model
from edge.types import F64, U8, Bools
from tools.bench.changes_scene import CELL_M, Cutout, Scene, Stand

EACH = 2  # things that come, and that go
SEEN_PX, SEEN_VIEWS = 200, 5  # seen well
_OVERLAP = 0.5  # of what is shown of a thing and a mask: the model sees it
_ASKED_EVERY = 6  # images of a drive that the model is asked for
_BORDER_PX = 6
_EDGE_M, _APART_M = 0.03, 0.1  # of what is not free; of other things
_FOOT_M = 0.08  # what is wider is so only above
_LIES_SHARE = 0.3  # of the images that show a place, that see something lie there
_PLACES = 25  # that are tried for each thing
_EVERY = 5  # images of the video that are asked whether they show it
_TABLES = ("dining table", "bench", "desk")


class Views(NamedTuple):
    """How images show a thing."""

    pixels: list[int]  # in each
    found: list[bool]  # whether the model sees it, in each that it is asked for

    @property
    def clear(self) -> list[int]:
        """Those that show enough of it."""
        return [n for n in self.pixels if n >= SEEN_PX]


def find_places(scene: Scene, model: Model) -> F64:
    """Places (n, 2) on the ground where the model sees nothing lie, either."""
    shown, taken = np.zeros(len(scene.ground)), np.zeros(len(scene.ground))
    limit = np.array([scene.camera.width, scene.camera.height])
    for i in range(0, len(scene.recording), 10):
        rgb = scene.recording.colour(i)
        if rgb is None:
            continue
        pixels, depth = scene.pixels_at(i, scene.on_ground(scene.ground))
        rows = np.flatnonzero((depth > 0.3) & ((pixels >= 0) & (pixels < limit - 1)).all(axis=1))
        at = np.rint(pixels[rows]).astype(int)
        over = np.zeros(limit[::-1], bool)
        seen = model.segment(rgb)
        for label, mask in zip(seen.classes, seen.masks, strict=True):
            if model.contract.names[int(label)] not in _TABLES:
                h, w = mask.inside.shape
                over[mask.top : mask.top + h, mask.left : mask.left + w] |= mask.inside
        shown[rows] += 1
        taken[rows] += over[at[:, 1], at[:, 0]]
    free: F64 = scene.ground[taken <= _LIES_SHARE * np.maximum(shown, 1)]
    return free


def make_composites(
    scene: Scene,
    things: Sequence[Cutout],
    places: F64,
    model: Model,
    folder: Path,
    ranges: tuple[range, range],
    number: int,
) -> list[dict[str, Any]]:
    """Write the recordings `map` and `changed` of images `ranges`; what differs between them.

    `number` counts sets of composites: each has other things at other places.
    """
    rng = np.random.default_rng([number, 71])
    stands: list[Stand] = []
    for n in range(len(things)):  # some find no place
        thing = things[(2 * EACH * number + n) % len(things)]
        stand = _put_down(scene, thing, places, stands, ranges, rng)
        if stand is not None:
            stands.append(stand)
        if len(stands) == 2 * EACH:
            break
    gone, new = stands[0::2], stands[1::2]
    truth = []
    for kind, kept, own in (("removed", gone, 0), ("added", new, 1)):
        name, every = ("map", 1) if own == 0 else ("changed", _ASKED_EVERY)
        views = _write(scene, folder / name, ranges[own], kept, model, every)
        for stand, here in zip(kept, views, strict=True):
            other = _shown(scene, stand, ranges[1 - own], (gone, new)[1 - own])
            truth.append(_row(kind, stand, here, other))
    (folder / "truth.json").write_text(json.dumps(truth, indent=1))
    return truth


def _put_down(
    scene: Scene,
    thing: Cutout,
    places: F64,
    stands: Sequence[Stand],
    ranges: tuple[range, range],
    rng: np.random.Generator,
) -> Stand | None:
    """The place, free and well in view of both parts of the video, that most images show."""
    best: tuple[int, Stand | None] = (0, None)
    tried = 0
    foot_m = np.inf if thing.is_flat else _FOOT_M
    turn = float(rng.uniform(0.0, 2.0 * np.pi)) if thing.is_flat else 0.0
    for row in rng.permutation(len(places)).tolist():
        foot = scene.on_ground(places[row][None])[0]
        stand = Stand(thing, foot, scene.up, turn)
        if not _is_free(places, places[row], min(stand.reach_m, foot_m) + _EDGE_M):
            continue
        if any(
            np.linalg.norm(foot - other.foot) < stand.reach_m + other.reach_m + _APART_M
            for other in stands
        ):
            continue
        spans = (range(span.start, span.stop, _EVERY) for span in ranges)
        views = min(len(_in_view(scene, stand, span)) for span in spans)
        if views > best[0]:
            best = (views, stand)
        tried += 1
        if tried == _PLACES:
            break
    return best[1] if best[0] >= SEEN_VIEWS else None


def _is_free(places: F64, place: F64, reach_m: float) -> bool:
    """Whether all the cells about a place are free."""
    near = np.linalg.norm(places - place, axis=1) < reach_m
    return bool(near.sum() >= 0.95 * np.pi * (reach_m / CELL_M) ** 2)


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


def _write(
    scene: Scene, folder: Path, span: range, stands: Sequence[Stand], model: Model, every: int
) -> list[Views]:
    """The recording of some images with things in them; how it shows each of them."""
    (folder / "rgb").mkdir(parents=True, exist_ok=True)
    views = [Views([], []) for _ in stands]
    for number, (i, bgr) in enumerate(_images(scene.recording, span)):
        bgr, shown = _paint(scene, bgr, i, stands)
        found = _found(bgr, model, shown) if number % every == 0 else []
        for view, pixels in zip(views, shown, strict=True):
            view.pixels.append(int(pixels.sum()))
        for view, is_found in zip(views, found, strict=False):
            view.found.append(is_found)
        cv2.imwrite(str(folder / "rgb" / f"{i:06d}.jpg"), bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])
    t_s = scene.recording.t_ns * 1e-9
    lines = [f"{t_s[i]:.6f} rgb/{i:06d}.jpg\n" for i in span]
    (folder / "rgb.txt").write_text("# time_s path\n" + "".join(lines))
    for name in ("camera.toml", "groundtruth.txt"):
        (folder / name).write_bytes((scene.recording.root / name).read_bytes())
    return views


def _paint(scene: Scene, bgr: U8, i: int, stands: Sequence[Stand]) -> tuple[U8, list[Bools]]:
    """Image `i` with things in it, and which pixels show each."""
    far = [scene.pixels_at(i, stand.foot[None])[1][0] for stand in stands]
    shown = [np.zeros(bgr.shape[:2], bool) for _ in stands]
    for n in np.argsort(-np.array(far), kind="stable").tolist():
        bgr, pixels = scene.paint(bgr, i, stands[n])
        for other in shown:
            other &= ~pixels  # it stands before them
        shown[n] = pixels
    return bgr, shown


def _found(bgr: U8, model: Model, shown: Sequence[Bools]) -> list[bool]:
    """Whether the model sees each thing, under whatever name."""
    seen = model.segment(np.ascontiguousarray(bgr[:, :, ::-1]))
    found = []
    for pixels in shown:
        best = 0.0
        for mask in seen.masks:
            h, w = mask.inside.shape
            part = pixels[mask.top : mask.top + h, mask.left : mask.left + w]
            common = int((part & mask.inside).sum())
            best = max(best, common / max(int(pixels.sum() + mask.inside.sum()) - common, 1))
        found.append(best >= _OVERLAP)
    return found


def _images(recording: Recording, span: range) -> Iterator[tuple[int, U8]]:
    for i in span:
        rgb = recording.colour(i)
        if rgb is not None:
            yield i, np.ascontiguousarray(rgb[:, :, ::-1])


def _shown(scene: Scene, stand: Stand, span: range, others: Sequence[Stand]) -> list[int]:
    """How many pixels of a thing images with others in them would show."""
    blank = np.zeros((scene.camera.height, scene.camera.width, 3), np.uint8)
    return [int(_paint(scene, blank, i, [*others, stand])[1][-1].sum()) for i in span]


def _row(kind: str, stand: Stand, here: Views, other: Sequence[int]) -> dict[str, Any]:
    width, height = stand.size_m
    clear = here.clear
    found = sum(here.found)
    in_both = min(len(clear), sum(n >= SEEN_PX for n in other))
    return {
        "kind": kind,
        "label": stand.thing.label,
        "center": stand.center.round(4).tolist(),
        "size": [width, height, width],
        "views": len(clear),
        "median_px": float(np.median(clear)) if clear else 0.0,
        "found": found,
        "asked": len(here.found),
        "in_both": in_both,
        # Both parts show it, and the model sees it where it is: else nobody could tell.
        "well": min(in_both, found) >= SEEN_VIEWS,
    }
