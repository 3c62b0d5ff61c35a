# SPDX-License-Identifier: Apache-2.0
"""What has come and gone: told and missed, wrongly told, and how far off, each beside its bound.

    python -m tools.bench.changes [DATA] [--out FOLDER] [--only KIND ...] [--rooms N] [--minutes N]

rooms       of the simulator, before and after people were in them (model of key colours)
unchanged   the same rooms as they were, in another light: a minute each, nothing may be told
office      DATA/office, its drives `map` and `changed` (model of key colours)
video       DATA/redkitchen, each end of it in a map of the rest, with the trained model in
            DATA/models: nothing changed, nothing may be told
composites  the same video with things in it that were cut out of it and of DATA/paslcd_pairs

Where there is no DATA, only rooms are measured. All that is rendered, built and found is kept in
FOLDER: a command that was interrupted goes on where it was, one after a change of the code measures
anew. A room takes some two minutes of processor time, with its unchanged minute three.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import onnx

from edge.config.segmenter import SegmenterConfig
from edge.runtime.kernel_cache import use_kernel_cache
from edge.segmenter.model import Model
from edge.types import F64
from tools.bench.changes_composites import find_places, make_composites
from tools.bench.changes_rooms import make_room_drives
from tools.bench.changes_scene import Cutout, Scene
from tools.bench.changes_score import BOUNDS, HEAD, Kept, Score, score_run
from tools.bench.changes_things import cut_out
from tools.bench.scoring import ROOT, where_measured
from tools.key_colour_model import FINE, make_model

KINDS = ("rooms", "unchanged", "office", "video", "composites")
_KEYS = {"ball", "mug", "carton", "figurine", "monkey"}  # what the model of key colours can see
# The rooms' cameras see all of it at their own size; it parts things as far as trained models do.
_KEY_MODEL = (448, 320, FINE)
_SETS = 12  # of composites
_WIDTH = 24  # of the bar
_DEPTHS, _DEPTHS_EVERY = 4000, 10  # of an image; images, for what hides things in composites
_VIDEO = ((slice(0, 300), slice(300, 500)), (slice(200, 500), slice(0, 200)))


class Case(NamedTuple):
    """One drive and how it is measured."""

    name: str
    measure: Callable[[], Score]


def main() -> int:
    """Measure and print; 1 where a bound is missed."""
    options = _parser().parse_args()
    use_kernel_cache()
    options.out.mkdir(parents=True, exist_ok=True)
    cases = list(_cases(options))
    print(where_measured(), f"kept in {options.out}", "", HEAD, sep="\n", flush=True)
    try:
        scores = list(_measure(cases, Kept(options.out / "scores", _digest(options.data))))
    except KeyboardInterrupt:
        print("\ninterrupted: the same command goes on from here", file=sys.stderr)
        return 130
    rows = list(filter(None, (bound.row(scores) for bound in BOUNDS)))
    print("", *rows, sep="\n")
    return int(any(row.endswith("MISSED") for row in rows))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.changes",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    data, out = ROOT.parent / "shared" / "data", Path(tempfile.gettempdir()) / "mapvo-changes"
    parser.add_argument(
        "data", type=Path, nargs="?", default=data, help="recordings (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, default=out, help="(default: %(default)s)")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=KINDS, metavar="KIND")
    parser.add_argument("--rooms", type=int, default=12, help="how many (default: %(default)s)")
    parser.add_argument("--first", type=int, default=1, help="seed of the first (default: 1)")
    parser.add_argument("--minutes", type=int, default=10, help="unchanged (default: 10)")
    return parser


def _measure(cases: Sequence[Case], kept: Kept) -> Iterator[Score]:
    """Scores, each printed as soon as it is known."""
    began = time.monotonic()
    for number, case in enumerate(cases):
        score = kept.get(case.name)
        if score is None:
            _tell(number, len(cases), case.name, time.monotonic() - began)
            score = case.measure()
            kept.put(score)
            _tell()
        print(score.row(), flush=True)
        yield score


def _tell(done: int = 0, total: int = 0, name: str = "", elapsed_s: float = 0.0) -> None:
    """Say how far it is on a terminal; no words: leave the line to others."""
    if sys.stderr.isatty():
        filled = "#" * (_WIDTH * done // max(total, 1))
        words = f"[{filled:<{_WIDTH}}] {done} of {total} in {elapsed_s / 60.0:.0f} min, now {name}"
        sys.stderr.write("\r\x1b[K" + (words if name else ""))
        sys.stderr.flush()


def _digest(data: Path) -> str:
    """Of all that figures depend on: code, models, and where the recordings are."""
    digest = sha256(str(data.resolve()).encode())
    sources = (file for part in ("edge", "maps", "tools") for file in (ROOT / part).rglob("*.py"))
    for file in (*sorted(sources), *_trained(data)):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _trained(data: Path) -> list[Path]:
    return sorted((data / "models").glob("*.onnx"))[:1]


def _cases(options: argparse.Namespace) -> Iterator[Case]:
    only, data, out = options.only, options.data, options.out
    key = out / "key_colours.onnx"
    onnx.save(make_model(*_KEY_MODEL), key)
    for number in range(options.rooms):
        minutes = len(range(number, options.minutes, options.rooms))
        room = partial(_room, options.first + number, key, out, minutes)
        name = f"room-{options.first + number}"
        if "rooms" in only:
            yield Case(name, partial(room, name, None))
        for drive in range(minutes if "unchanged" in only else 0):
            again = f"{name}{f'.{drive + 1}' if drive else ''} unchanged"
            yield Case(again, partial(room, again, drive))
    if "office" in only and _is_there(data / "office"):
        yield Case("office", partial(_office, data / "office", key, out / "office"))
    if not {"video", "composites"}.isdisjoint(only) and _is_there(data / "redkitchen"):
        yield from _of_video(data, out, only)


def _is_there(folder: Path) -> bool:
    if not folder.is_dir():
        print(f"{folder}: is not there, left out")
    return folder.is_dir()


def _of_video(data: Path, out: Path, only: Sequence[str]) -> Iterator[Case]:
    video, models = data / "redkitchen", _trained(data)
    if not models:
        print(f"{data / 'models'}: holds no trained model (*.onnx), {video.name} is left out")
        return
    for number, (mapped, played) in enumerate(_VIDEO if "video" in only else ()):
        name = f"video {played.start}:{played.stop}"
        place = out / f"video-{number}"
        yield Case(name, partial(_unchanged, name, video, models[0], place, mapped, played))
    workshop = cache(partial(_workshop, video, models[0], data / "paslcd_pairs", out))
    for number in range(_SETS if "composites" in only else 0):
        yield Case(f"composites-{number}", partial(_composites, number, workshop, models[0], out))


def _room(seed: int, model: Path, out: Path, minutes: int, name: str, drive: int | None) -> Score:
    """One drive through a room: changed (None), or one of the unchanged."""
    folder = out / f"room-{seed}"
    room = make_room_drives(seed, folder / "drives", same=minutes)
    map_ = folder / "map"
    _build(room.folder / "map", map_, model, None, 1)
    if drive is None:
        _replay(room.folder / "changed", map_, folder / "run", model, None)
        return score_run(name, folder / "run", room.truth, _KEYS)
    run = folder / f"run-same-{drive + 1}"
    _replay(room.unchanged(drive), map_, run, model, None)
    return score_run(name, run, [], _KEYS)


def _office(drives: Path, model: Path, folder: Path) -> Score:
    _build(drives / "map", folder / "map", model, None, 1)
    _replay(drives / "changed", folder / "map", folder / "run", model, None)
    truth = json.loads((drives / "changed" / "info.json").read_text())["changes"]
    return score_run(folder.name, folder / "run", truth, _KEYS)


def _unchanged(
    name: str, video: Path, model: Path, place: Path, mapped: slice, played: slice
) -> Score:
    _build(video, place / "map", model, mapped, 5)
    _replay(video, place / "map", place / "run", model, played)
    return score_run(name, place / "run", [], None)


class _Workshop(NamedTuple):
    """What composites are made of."""

    scene: Scene
    things: list[Cutout]
    places: F64  # (n, 2)
    eye: Model


def _workshop(video: Path, model: Path, photos: Path, out: Path) -> _Workshop:
    depths = out / "video-depths"
    if not depths.exists():
        from maps.build import BuildInput, build
        from maps.settings import BuildSettings

        settings = BuildSettings(depth="multiview", max_depth_samples=_DEPTHS)
        build(BuildInput([video], None, _DEPTHS_EVERY), depths, settings)
    scene, eye = Scene(video, depths), Model(model, SegmenterConfig())
    things = cut_out(scene, photos if _is_there(photos) else None, eye)
    return _Workshop(scene, things, find_places(scene, eye), eye)


def _composites(number: int, workshop: Callable[[], _Workshop], model: Path, out: Path) -> Score:
    place, shop = out / f"composites-{number}", workshop()
    mapped, played = _VIDEO[number % len(_VIDEO)]
    ranges = range(mapped.start, mapped.stop, 5), range(played.start, played.stop)
    truth = make_composites(shop.scene, shop.things, shop.places, shop.eye, place, ranges, number)
    _build(place / "map", place / "built", model, None, 1)
    _replay(place / "changed", place / "built", place / "run", model, None)
    return score_run(place.name, place / "run", truth, None)


def _build(drive: Path, out: Path, model: Path, frames: slice | None, every: int) -> None:
    from maps.build import BuildInput, build
    from maps.settings import BuildSettings

    build(BuildInput([drive], frames, every), out, BuildSettings(), segmenter=model)


def _replay(drive: Path, map_: Path, out: Path, model: Path, frames: slice | None) -> None:
    from edge.config import Config
    from edge.runtime.commands import with_segmenter
    from edge.runtime.replay import ReplayJob, replay

    replay(ReplayJob(drive, out, map_, frames), with_segmenter(Config(), model))


if __name__ == "__main__":
    sys.exit(main())
