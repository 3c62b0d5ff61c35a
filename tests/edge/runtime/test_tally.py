# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import pytest

from edge.outputs.report import FrameReport
from edge.runtime.tally import Tally
from edge.types import LineSearch
from tests.edge.outputs import reports


def with_searches() -> FrameReport:
    """A frame with two searches in keyframes and one for a fix."""
    report = reports.report(1, fixes=(reports.fix(1), reports.fix(1)), with_keyframe=True)
    assert report.update.keyframe is not None
    keyframe = replace(
        report.update.keyframe, line_searches=(LineSearch(10, 2.0), LineSearch(21, 4.0))
    )
    update = replace(report.update, keyframe=keyframe)
    certain, doubtful = report.fixes
    told = replace(doubtful.fix, line_searches=(LineSearch(120, 9.0),))
    return replace(report, update=update, fixes=(certain, replace(doubtful, fix=told)))


def test_line_work_is_told_apart_by_its_end() -> None:
    tally = Tally()
    lost = reports.lost(3)
    starting = replace(lost, update=replace(lost.update, line_searches=(LineSearch(7, 1.0),)))
    for report in (with_searches(), reports.report(2), starting):
        tally.add(report, 0.0)
    work = tally.stats(0)["line_work"]
    found = {name: (work[name]["images"], work[name]["segments_per_image"]) for name in work}
    assert found == {
        "start": (1, 7.0),
        "window": (2, 15.5),
        "fix": (1, 120.0),
    }
    assert work["window"]["ms"]["max"] == 4.0
    assert work["fix"]["ms"]["median"] == pytest.approx(9.0, rel=0.01)


def test_a_run_without_lines_says_so() -> None:
    tally = Tally()
    tally.add(reports.report(1, fixes=(reports.fix(1),), with_keyframe=True), 0.0)
    for work in tally.stats(0)["line_work"].values():
        assert (work["images"], work["segments_per_image"], work["ms"]["max"]) == (0, 0.0, 0.0)
