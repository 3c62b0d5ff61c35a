# SPDX-License-Identifier: Apache-2.0
"""What was told of changes against what is true, and what of that must hold."""

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

_WELL_PX, _WELL_VIEWS = 200.0, 5  # seen well
_SAME_M = 0.1  # and half of a thing: so near it is meant
HEAD = f"{'':24} {'wanted':>6} {'no class':>9} {'told':>5} {'false':>6} {'cm':>6}"


class Score(NamedTuple):
    """One drive through a place."""

    name: str
    wanted: int  # changes that the drive shows well
    unseen: int  # of those, of classes that the model does not know
    told: int  # of the wanted ones
    false: int
    errors_m: tuple[float, ...]
    shown: int = 0  # changes that both drives show well, whether the model ever sees them or not
    told_of_shown: int = 0

    def row(self) -> str:
        """One line of the table."""
        off = f"{100.0 * float(np.median(self.errors_m)):6.1f}" if self.errors_m else "     -"
        return (
            f"{self.name:24} {self.wanted:6d} {self.unseen:9d} {self.told:5d} {self.false:6d} {off}"
        )


class Kept:
    """Scores of a folder, kept for as long as what they were measured with is the same."""

    def __init__(self, folder: Path, digest: str) -> None:
        self._folder, self._digest = folder, digest

    def get(self, name: str) -> Score | None:
        """That of a drive; None where it is to be measured."""
        try:
            digest, score = msgspec.json.decode(self._file(name).read_bytes(), type=_Row)
        except (FileNotFoundError, msgspec.DecodeError):  # cut off while it was written, too
            return None
        return score if digest == self._digest else None

    def put(self, score: Score) -> None:
        """Keep one."""
        self._folder.mkdir(parents=True, exist_ok=True)
        self._file(score.name).write_bytes(msgspec.json.encode(_Row(self._digest, score)))

    def _file(self, name: str) -> Path:
        return self._folder / f"{name.replace(' ', '-').replace(':', '-')}.json"


class _Row(NamedTuple):
    digest: str
    score: Score


def score_run(name: str, run: Path, truth: list[dict[str, Any]], classes: set[str] | None) -> Score:
    """Pair events with true changes, the nearest first; `classes` the model knows (None: all)."""
    events = [json.loads(line) for line in (run / "changes.jsonl").read_text().splitlines()]
    found = _pair(events, truth)
    well = [t for t, change in enumerate(truth) if _is_seen_well(change)]
    shown = [t for t in range(len(truth)) if t in well or _is_shown_well(truth[t])]
    return Score(
        name,
        len(well),
        sum(classes is not None and truth[t]["label"] not in classes for t in well),
        sum(t in found for t in well),
        len(events) - len(found),
        tuple(found[t] for t in well if t in found),
        len(shown),
        sum(t in found for t in shown),
    )


def _is_seen_well(change: dict[str, Any]) -> bool:
    if "well" in change:
        return bool(change["well"])
    return bool(change["views"] >= _WELL_VIEWS and change["median_px"] >= _WELL_PX)


def _is_shown_well(change: dict[str, Any]) -> bool:
    return bool(change.get("in_both", 0) >= _WELL_VIEWS)


def _pair(events: list[dict[str, Any]], truth: list[dict[str, Any]]) -> dict[int, float]:
    """How far off [m] the event of each true change is that has one."""
    center = [np.array(change["center"]) for change in truth]
    pairs = sorted(
        (float(np.linalg.norm(np.array(event["center_map_m"]) - center[t])), e, t)
        for e, event in enumerate(events)
        for t, change in enumerate(truth)
        if event["kind"] == change["kind"]
    )
    found: dict[int, float] = {}
    used: set[int] = set()
    for distance, e, t in pairs:
        reach = _SAME_M + 0.5 * float(np.max(truth[t]["size"]))
        if distance < reach and t not in found and e not in used:
            found[t] = distance
            used.add(e)
    return found


class Bound(NamedTuple):
    """What must hold of some drives."""

    what: str
    drives: str  # how their names begin, or end
    figure: Callable[[Sequence[Score]], float | None]  # None: nothing was measured
    bound: float | None  # None: told, and not judged
    is_least: bool

    def row(self, scores: Iterable[Score]) -> str | None:
        """One line: our figure beside the bound."""
        value = self.figure([score for score in scores if is_of(score.name, self.drives)])
        if value is None:
            return None
        if self.bound is None:
            return f"{self.what:40} {value:7.2f}"
        holds = value >= self.bound if self.is_least else value <= self.bound
        sign = ">=" if self.is_least else "<="
        return f"{self.what:40} {value:7.2f}  {sign} {self.bound:<5g} {'OK' if holds else 'MISSED'}"


def is_of(name: str, drives: str) -> bool:
    """Whether a drive is of a kind: rooms, unchanged, office, video or composites."""
    kind = "unchanged" if name.endswith("unchanged") else name.split()[0].split("-")[0]
    return kind in drives.split()


def _recall(scores: Sequence[Score]) -> float | None:
    wanted = sum(score.wanted - score.unseen for score in scores)
    return sum(score.told for score in scores) / wanted if wanted else None


def _recall_of_shown(scores: Sequence[Score]) -> float | None:
    shown = sum(score.shown for score in scores)
    return sum(score.told_of_shown for score in scores) / shown if shown else None


def _precision(scores: Sequence[Score]) -> float | None:
    told = sum(score.told for score in scores)
    false = _false(scores) or 0.0
    return told / (told + false) if told + false else None


def _false(scores: Sequence[Score]) -> float | None:
    return float(sum(score.false for score in scores)) if scores else None


def _off_cm(scores: Sequence[Score]) -> float | None:
    errors = [error for score in scores for error in score.errors_m]
    return 100.0 * float(np.median(errors)) if errors else None


BOUNDS = (
    Bound("rooms, office: told of those seen well", "room office", _recall, 0.95, True),
    Bound("rooms, office: true of those told", "room office", _precision, 0.95, True),
    Bound("rooms, office: median error [cm]", "room office", _off_cm, 5.0, False),
    Bound("unchanged rooms: events", "unchanged", _false, 0.0, False),
    Bound("unchanged video: events", "video", _false, 0.0, False),
    Bound("composites: told of those seen well", "composites", _recall, 0.8, True),
    Bound("  and of those the model hardly sees", "composites", _recall_of_shown, None, True),
    Bound("composites: true of those told", "composites", _precision, 0.9, True),
)
