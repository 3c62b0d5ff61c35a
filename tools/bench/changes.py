# SPDX-License-Identifier: Apache-2.0
"""What has come and gone: told and missed, wrongly told, and how far off.

`python -m tools.bench.changes --out FOLDER [--office DIR] [--rooms N] [--first SEED] [--same N]
[--video DIR --model MODEL.onnx [--composites [--photos DIR]]]`: rooms of the simulator, changed
and (`same` drives of a minute in all, as many in each room) unchanged in another light, and the
recording `office` (its drives `map` and `changed`, truth in changed/info.json) with the model of
key colours; a video in which nothing changed with a real model, where what is told is false, and
the same video with things in it that were cut out of it and of photos.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx

from edge.config.segmenter import SegmenterConfig
from edge.runtime.kernel_cache import use_kernel_cache
from edge.segmenter.model import Model
from tools.bench.changes_composites import find_places, make_composites
from tools.bench.changes_rooms import make_room_drives
from tools.bench.changes_scene import Scene
from tools.bench.changes_things import cut_out
from tools.key_colour_model import make_model

_KEYS = {"ball", "mug", "carton", "figurine", "monkey"}  # what the model of key colours can see
_WELL_PX, _WELL_VIEWS = 200.0, 5  # seen well
_SAME_M = 0.1  # and half of a thing: so near it is meant
_SETS = 6  # of composites
_DEPTHS, _DEPTHS_EVERY = 4000, 10  # of an image; images, for what hides things in composites
_VIDEO = ((slice(0, 300), slice(300, 500)), (slice(200, 500), slice(0, 200)))


class Score(NamedTuple):
    """One drive through a place."""

    name: str
    wanted: int  # changes that the drive shows well
    unseen: int  # of those, of classes that the model does not know
    told: int  # of the wanted ones
    false: int
    errors_m: tuple[float, ...]

    def row(self) -> str:
        """One line of the table."""
        off = f"{100.0 * float(np.median(self.errors_m)):6.1f}" if self.errors_m else "     -"
        return (
            f"{self.name:24} {self.wanted:6d} {self.unseen:9d} {self.told:5d} {self.false:6d} {off}"
        )


def main() -> None:
    """Run and print the table."""
    arguments = _parser().parse_args()
    use_kernel_cache()
    arguments.out.mkdir(parents=True, exist_ok=True)
    key = arguments.out / "key_colours.onnx"
    onnx.save(make_model(), key)
    scores = []
    if arguments.office:
        scores.append(_drive(arguments.office, key, arguments.out / "office"))
    for room in range(arguments.rooms):
        same = len(range(room, arguments.same, arguments.rooms))
        seed = arguments.first + room
        scores += _room(seed, key, arguments.out / f"room-{seed}", same)
    if arguments.video:
        scores += _video(arguments.video, arguments.model, arguments.out)
    composed = []
    if arguments.composites:
        composed = _composites(arguments.video, arguments.model, arguments.out, arguments.photos)
    print(f"{'':24} {'wanted':>6} {'no class':>9} {'told':>5} {'false':>6} {'cm':>6}")
    for score in (*scores, *composed):
        print(score.row())
    _judge(scores, 0.95, 0.95)
    _judge(composed, 0.8, 0.9)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Changes of places: told, missed, false.")
    parser.add_argument("--out", type=Path, required=True, help="folder for maps and runs")
    parser.add_argument("--office", type=Path, help="folder with the drives map and changed")
    parser.add_argument("--rooms", type=int, default=0, help="rooms of the simulator")
    parser.add_argument("--first", type=int, default=1, help="seed of the first room")
    parser.add_argument("--same", type=int, default=0, help="drives through them, unchanged")
    parser.add_argument("--video", type=Path, help="recording in which nothing changes")
    parser.add_argument("--model", type=Path, help="a trained model, for the video")
    parser.add_argument("--composites", action="store_true", help="put things into the video")
    parser.add_argument("--photos", type=Path, help="folders of photos to cut things out of, too")
    return parser


def _judge(scores: Sequence[Score], recall: float, precision: float) -> None:
    wanted = sum(score.wanted for score in scores)
    told, false = sum(score.told for score in scores), sum(score.false for score in scores)
    if wanted:
        print(f"recall {told / wanted:.2f} (bound {recall})", end=", ")
    if told + false:
        print(f"precision {told / (told + false):.2f} (bound {precision})", end=", ")
    errors = [error for score in scores for error in score.errors_m]
    if errors:
        print(f"median error {100.0 * float(np.median(errors)):.1f} cm (bound 5)")


def _room(seed: int, model: Path, folder: Path, same: int) -> list[Score]:
    room = make_room_drives(seed, folder / "drives", same=same)
    map_, drives = folder / "map", folder / "drives"
    _build(drives / "map", map_, model, None, 1)
    _replay(drives / "changed", map_, folder / "run", model, None)
    scores = [_score(folder.name, _events(folder / "run"), room.truth)]
    for number in range(same):
        run = folder / f"run-same-{number + 1}"
        _replay(room.unchanged(number), map_, run, model, None)
        scores.append(_score(f"{folder.name} unchanged", _events(run), []))
    return scores


def _drive(drives: Path, model: Path, folder: Path) -> Score:
    _build(drives / "map", folder / "map", model, None, 1)
    _replay(drives / "changed", folder / "map", folder / "run", model, None)
    truth = json.loads((drives / "changed" / "info.json").read_text())["changes"]
    return _score(folder.name, _events(folder / "run"), truth)


def _video(video: Path, model: Path, folder: Path) -> list[Score]:
    scores = []
    for number, (mapped, played) in enumerate(_VIDEO):
        place = folder / f"video-{number}"
        _build(video, place / "map", model, mapped, 5)
        _replay(video, place / "map", place / "run", model, played)
        name = f"{video.name} {played.start}:{played.stop}"
        scores.append(_score(name, _events(place / "run"), []))
    return scores


def _composites(video: Path, model: Path, folder: Path, photos: Path | None) -> list[Score]:
    depths = folder / "video-depths"
    if not depths.exists():
        from maps.build import BuildInput, build
        from maps.settings import BuildSettings

        settings = BuildSettings(depth="multiview", max_depth_samples=_DEPTHS)
        build(BuildInput([video], None, _DEPTHS_EVERY), depths, settings)
    scene = Scene(video, depths)
    eye = Model(model, SegmenterConfig())
    things, places = cut_out(scene, photos, eye), find_places(scene, eye)
    scores = []
    for number in range(_SETS):
        mapped, played = _VIDEO[number % len(_VIDEO)]
        place = folder / f"composites-{number}"
        ranges = range(mapped.start, mapped.stop, 5), range(played.start, played.stop)
        truth = make_composites(scene, things, places, eye, place, ranges, number)
        _build(place / "map", place / "built", model, None, 1)
        _replay(place / "changed", place / "built", place / "run", model, None)
        scores.append(_score(place.name, _events(place / "run"), truth, None))
    return scores


def _build(drive: Path, out: Path, model: Path, frames: slice | None, every: int) -> None:
    from maps.build import BuildInput, build
    from maps.settings import BuildSettings

    build(BuildInput([drive], frames, every), out, BuildSettings(), segmenter=model)


def _replay(drive: Path, map_: Path, out: Path, model: Path, frames: slice | None) -> None:
    from edge.config import Config
    from edge.runtime.commands import with_segmenter
    from edge.runtime.replay import ReplayJob, replay

    replay(ReplayJob(drive, out, map_, frames), with_segmenter(Config(), model))


def _events(run: Path) -> list[dict]:  # type: ignore[type-arg]
    return [json.loads(line) for line in (run / "changes.jsonl").read_text().splitlines()]


def _score(
    name: str,
    events: list[dict],  # type: ignore[type-arg]
    truth: list[dict],  # type: ignore[type-arg]
    classes: set[str] | None = _KEYS,
) -> Score:
    """Pair events with true changes, the nearest first; `classes` the model knows (None: all)."""
    center = [np.array(change["center"]) for change in truth]
    pairs = sorted(
        (float(np.linalg.norm(np.array(event["center_map_m"]) - center[t])), e, t)
        for e, event in enumerate(events)
        for t, change in enumerate(truth)
        if event["kind"] == change["kind"]
    )
    found: dict[int, tuple[int, float]] = {}
    for distance, e, t in pairs:
        reach = _SAME_M + 0.5 * float(np.max(truth[t]["size"]))
        if distance < reach and t not in found and e not in {pair[0] for pair in found.values()}:
            found[t] = (e, distance)
    well = [
        t
        for t, change in enumerate(truth)
        if change.get("well", change["views"] >= _WELL_VIEWS and change["median_px"] >= _WELL_PX)
    ]
    return Score(
        name,
        len(well),
        sum(classes is not None and truth[t]["label"] not in classes for t in well),
        sum(t in found for t in well),
        len(events) - len(found),
        tuple(found[t][1] for t in well if t in found),
    )


if __name__ == "__main__":
    main()
