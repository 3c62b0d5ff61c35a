# SPDX-License-Identifier: Apache-2.0
"""What is told of changes without any model: of the true ones, of wrong ones, and at what cost.

`python -m tools.bench.changes_geometry --out FOLDER [--office DIR] [--video DIR] [--room DIR]...`:
the recording `office` (its drives map, query and changed), a video in which nothing changed (each
end of it in a map of the rest), and rooms of the simulator (their drives map, changed and same, as
`tools.bench.changes` leaves them). A model sees more (`tools.bench.changes`): here wrong events
count, missed ones less.
"""

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from edge.cameras.recording import open_recording
from edge.changes.unlabelled import UnlabelledChanges
from edge.config import Config
from edge.runtime.kernel_cache import use_kernel_cache
from edge.runtime.player import OfflinePlayer
from edge.runtime.sights import Chooser
from edge.runtime.stages import replay_pipeline
from edge.tiles.reader import open_map
from edge.types import ChangeEvent, Look

_VIDEO = ((slice(0, 300), slice(300, 500)), (slice(200, 500), slice(0, 200)))
_WELL_PX, _WELL_VIEWS = 200.0, 5
_LARGE_PX = 700.0
_SAME_M = 0.25  # an edge of a thing is told, not always its middle


class Case(NamedTuple):
    """A drive in a map."""

    name: str
    mapped: Path
    mapped_frames: slice | None
    every: int
    played: Path
    played_frames: slice | None = None


class Result(NamedTuple):
    """What came of it."""

    events: list[ChangeEvent]
    ms: list[float]  # processor time of each look


def main() -> None:
    """Run and print the table."""
    options = _parser().parse_args()
    use_kernel_cache()
    options.out.mkdir(parents=True, exist_ok=True)
    names = ("looks", "ms", "p95", "well", "large", "told", "false")
    print(" " * 26 + "".join(f"{name:>6}" for name in names))
    for case in _cases(options):
        print(_row(case, _run(case, options.out)), flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Changes without a model: told, false, time.")
    parser.add_argument("--out", type=Path, required=True, help="folder for maps")
    parser.add_argument("--office", type=Path, help="folder with the drives map, query, changed")
    parser.add_argument("--video", type=Path, help="recording in which nothing changes")
    parser.add_argument("--room", type=Path, action="append", default=[], help="a room's drives")
    return parser


def _cases(options: argparse.Namespace) -> Iterator[Case]:
    for place in filter(None, (options.office, *options.room)):
        for drive in ("query", "same", "changed"):
            if (place / drive / "info.json").exists():  # written last
                name = f"{place.parent.name if place.name == 'drives' else place.name} {drive}"
                yield Case(name, place / "map", None, 1, place / drive)
    for mapped, played in _VIDEO if options.video else ():
        name = f"{options.video.name} {played.start}:{played.stop}"
        yield Case(name, options.video, mapped, 5, options.video, played)


def _run(case: Case, folder: Path) -> Result:
    span = case.mapped_frames
    name = "all" if span is None else f"{span.start}-{span.stop}"
    map_folder = folder / f"{case.name.split()[0]}-{case.mapped.name}-{name}.map"
    if not map_folder.exists():
        from maps.build import BuildInput, build
        from maps.settings import BuildSettings

        build(BuildInput([case.mapped], span, case.every), map_folder, BuildSettings())
    map_ = open_map(map_folder)
    changes = msgspec.structs.replace(Config().changes, without_model=True)
    config = msgspec.structs.replace(Config(), changes=changes)
    recording = open_recording(case.played, frames=case.played_frames)
    camera = map_.camera_for(recording.camera)
    chooser, stage = Chooser(config, camera), UnlabelledChanges(map_, camera, changes)
    ms = []
    with replay_pipeline(config, recording.camera, map_) as pipeline:
        for arrival in OfflinePlayer(recording):
            sight = chooser.choose(arrival.frame, pipeline.step(arrival.frame))
            if sight is None or sight.T_map_cam is None:
                continue
            frame = sight.frame
            look = Look(
                *(frame.index, frame.t_ns, frame.image, sight.T_map_cam, sight.surface()),
                depth=sight.depth,
            )
            began_ns = time.thread_time_ns()
            stage.step(look)
            ms.append(1e-6 * (time.thread_time_ns() - began_ns))
    return Result(stage.events, ms)


def _truth(drive: Path) -> list[dict[str, Any]]:
    """What differs in a drive; rooms keep it beside their drives."""
    of_room, about = drive.parent / "truth.json", drive / "info.json"
    if of_room.exists():
        told: list[dict[str, Any]] = json.loads(of_room.read_text())
        return told if drive.name == "changed" else []
    return json.loads(about.read_text()).get("changes", []) if about.exists() else []


def _row(case: Case, result: Result) -> str:
    """One line: changes that the drive shows well, the large of them, and what was told."""
    truth = _truth(case.played)
    well = [
        c for c in truth if c.get("well", c["median_px"] >= _WELL_PX and c["views"] >= _WELL_VIEWS)
    ]
    large = [c for c in well if c["median_px"] >= _LARGE_PX]
    told, false = set(), 0
    for event in result.events:
        at = [
            (float(np.linalg.norm(np.array(c["center"]) - event.center_map_m)), i)
            for i, c in enumerate(truth)
            if c["kind"] == event.kind
        ]
        distance, i = min(at, default=(np.inf, -1))
        if distance < _SAME_M:
            told.add(i)
        else:
            false += 1
    return (
        f"{case.name:26}{len(result.ms):6d}{np.median(result.ms):6.1f}"
        f"{np.percentile(result.ms, 95):6.1f}{len(well):6d}{len(large):6d}{len(told):6d}{false:6d}"
    )


if __name__ == "__main__":
    main()
