# SPDX-License-Identifier: Apache-2.0
import json
from pathlib import Path
from typing import Any

import pytest

from tools.bench.changes_score import BOUNDS, Kept, Score, score_run


def change(kind: str, x: float, *, well: bool = True) -> dict[str, Any]:
    return {
        "kind": kind, "label": "cup", "center": [x, 0.0, 1.0], "size": [0.1, 0.1, 0.1],
        "well": well,
    }  # fmt: skip


def told(folder: Path, *events: tuple[str, float]) -> Path:
    lines = [json.dumps({"kind": kind, "center_map_m": [x, 0.0, 1.0]}) for kind, x in events]
    (folder / "changes.jsonl").write_text("".join(line + "\n" for line in lines))
    return folder


def test_each_change_has_the_nearest_event_of_its_kind(tmp_path: Path) -> None:
    run = told(tmp_path, ("added", 0.05), ("added", 0.02), ("removed", 1.0))
    truth = [change("added", 0.0), change("added", 1.0), change("removed", 5.0)]

    score = score_run("room-1", run, truth, None)

    assert (score.wanted, score.told, score.false) == (3, 1, 2)
    assert score.errors_m == pytest.approx((0.02,))


def test_what_is_not_seen_well_is_neither_wanted_nor_false(tmp_path: Path) -> None:
    run = told(tmp_path, ("added", 0.0))

    score = score_run("room-1", run, [change("added", 0.0, well=False)], None)

    assert (score.wanted, score.told, score.false) == (0, 0, 0)


def test_scores_are_kept_while_what_made_them_is_the_same(tmp_path: Path) -> None:
    score = Score("room-1 unchanged", 2, 0, 1, 0, (0.03,))
    Kept(tmp_path, "a").put(score)

    assert Kept(tmp_path, "a").get(score.name) == score
    assert Kept(tmp_path, "b").get(score.name) is None
    assert Kept(tmp_path, "a").get("room-1") is None
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-5])
    assert Kept(tmp_path, "a").get(score.name) is None


def test_a_wrong_event_where_nothing_changed_misses_that_bound_only() -> None:
    scores = [
        Score("room-1", 2, 0, 2, 0, (0.01, 0.02)),
        Score("room-1.2 unchanged", 0, 0, 0, 1, ()),
    ]

    rows = [row for bound in BOUNDS if (row := bound.row(scores)) is not None]

    assert [row.split(":")[0] for row in rows if row.endswith("MISSED")] == ["unchanged rooms"]
    assert len(rows) == 4  # of what was not measured nothing is said


def test_what_a_model_hardly_ever_sees_is_counted_apart_and_not_judged() -> None:
    scores = [Score("composites-0", 2, 0, 2, 0, (0.01, 0.01), 8, 2)]
    rows = [row for bound in BOUNDS if (row := bound.row(scores)) is not None]

    assert [row.split()[-1] for row in rows] == ["OK", "0.25", "OK"]
