# SPDX-License-Identifier: Apache-2.0
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.geometry.camera import CameraModel
from edge.outputs import wire
from edge.outputs.change_message import ChangeMessage, change_message
from edge.outputs.rows import MaskRow, mask_row
from edge.outputs.run_folder import RunFolder
from edge.types import Bools, Mask
from tests.edge.outputs import reports


def unpacked(row: MaskRow) -> Bools:
    """What a reader of PROTOCOL.md makes of the runs."""
    values = np.arange(len(row.runs)) % 2 == 1
    return np.repeat(values, row.runs).reshape(row.height, row.width)


@pytest.mark.parametrize("seed", range(5))
def test_a_mask_comes_back_from_its_runs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    inside = rng.random((seed + 1, 7)) < (0.0, 0.2, 0.5, 0.8, 1.0)[seed]

    row = mask_row(Mask(3, 4, inside))

    assert (row.left, row.top) == (3, 4)
    np.testing.assert_array_equal(unpacked(row), inside)


@pytest.mark.parametrize("form", ["msgpack", "json"])
def test_a_change_goes_over_the_wire(form: wire.Format) -> None:
    event = reports.change(7)

    topic, message = wire.decode(wire.encode(change_message(event, 2, 99), form))

    assert topic == "change"
    assert isinstance(message, ChangeMessage)
    assert (message.seq, message.t_ns, message.kind) == (2, event.t_ns, "added")
    assert message.center_map_m == (1.0, 2.0, 3.0)
    (frame,) = message.evidence.frames
    assert frame.mask is not None
    assert event.evidence[0].mask is not None
    np.testing.assert_array_equal(unpacked(frame.mask), event.evidence[0].mask.inside)


def test_a_run_folder_has_a_line_for_each_change(tmp_path: Path) -> None:
    camera = CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5)
    with RunFolder(tmp_path / "run", camera) as folder:
        for index in range(3):
            changes = (reports.change(index),) if index else ()
            folder.write(replace(reports.report(index), changes=changes))
        folder.finish([], {"frames": 3, "fixes_tried": 0, "ms": {}})

    lines = [json.loads(t) for t in (tmp_path / "run" / "changes.jsonl").read_text().splitlines()]

    assert [line["id"] for line in lines] == [1, 2]
    promised = {
        "t_ns", "kind", "label", "score", "center_map_m", "extent_m", "n_views", "evidence",
    }  # fmt: skip
    assert promised <= lines[0].keys()
    assert lines[0]["evidence"]["log_odds"] == 3.0
