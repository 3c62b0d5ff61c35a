# SPDX-License-Identifier: Apache-2.0
"""What has come and gone: told and missed, wrongly told, and how far off.

`python -m tools.bench.changes --out FOLDER [--office DIR] [--video DIR --model MODEL.onnx]
[--rooms N] [--same N]`: rooms of the simulator, changed and (of the first `same` rooms, a minute
each) unchanged in another light, and the recording `office` (its drives `map` and `changed`, truth
in changed/info.json) with the model of key colours; and a video in which nothing changed with a
real model: what is told there is false.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx

from edge.runtime.kernel_cache import use_kernel_cache
from tools.bench.changes_rooms import make_room_drives
from tools.key_colour_model import make_model

_KEYS = {"ball", "mug", "carton", "figurine", "monkey"}  # what the model of key colours can see
_WELL_PX, _WELL_VIEWS = 200.0, 5  # seen well
_SAME_M = 0.1  # and half of a thing: so near it is meant
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
    rooms = range(1, arguments.rooms + 1)
    for seed in rooms:
        scores += _room(seed, key, arguments.out / f"room-{seed}", same=seed <= arguments.same)
    if arguments.video:
        scores += _video(arguments.video, arguments.model, arguments.out)
    print(f"{'':24} {'wanted':>6} {'no class':>9} {'told':>5} {'false':>6} {'cm':>6}")
    for score in scores:
        print(score.row())
    _judge(scores)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Changes of places: told, missed, false.")
    parser.add_argument("--out", type=Path, required=True, help="folder for maps and runs")
    parser.add_argument("--office", type=Path, help="folder with the drives map and changed")
    parser.add_argument("--rooms", type=int, default=0, help="rooms of the simulator")
    parser.add_argument("--same", type=int, default=0, help="of them, driven through unchanged")
    parser.add_argument("--video", type=Path, help="recording in which nothing changes")
    parser.add_argument("--model", type=Path, help="a trained model, for the video")
    return parser


def _judge(scores: Sequence[Score]) -> None:
    wanted = sum(score.wanted for score in scores)
    told, false = sum(score.told for score in scores), sum(score.false for score in scores)
    if wanted:
        print(f"recall {told / wanted:.2f} (bound 0.95)", end=", ")
    if told + false:
        print(f"precision {told / (told + false):.2f} (bound 0.95)", end=", ")
    errors = [error for score in scores for error in score.errors_m]
    if errors:
        print(f"median error {100.0 * float(np.median(errors)):.1f} cm (bound 5)")


def _room(seed: int, model: Path, folder: Path, *, same: bool) -> list[Score]:
    room = make_room_drives(seed, folder / "drives", same=same)
    map_, drives = folder / "map", folder / "drives"
    if not map_.exists():
        _build(drives / "map", map_, model, None, 1)
    _replay(drives / "changed", map_, folder / "run", model, None)
    scores = [_score(folder.name, _events(folder / "run"), room.truth)]
    if same:
        _replay(drives / "same", map_, folder / "run-same", model, None)
        scores.append(_score(f"{folder.name} unchanged", _events(folder / "run-same"), []))
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


def _score(name: str, events: list[dict], truth: list[dict]) -> Score:  # type: ignore[type-arg]
    """Pair events with true changes, the nearest first."""
    center = [np.array(change["center"]) for change in truth]
    pairs = sorted(
        (float(np.linalg.norm(np.array(event["center_map_m"]) - center[t])), e, t)
        for e, event in enumerate(events)
        for t, change in enumerate(truth)
        if event["kind"] == change["kind"]
    )
    found: dict[int, tuple[int, float]] = {}
    for distance, e, t in pairs:
        reach = _SAME_M + 0.5 * float(np.linalg.norm(truth[t]["size"]))
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
        sum(truth[t]["label"] not in _KEYS for t in well),
        sum(t in found for t in well),
        len(events) - len(found),
        tuple(found[t][1] for t in well if t in found),
    )


if __name__ == "__main__":
    main()
