# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

from edge.outputs.status import Facts, StatusTally
from tests.edge.outputs import reports

SECOND_NS = 1_000_000_000


def test_last_frames_word_is_good_for_a_second_only() -> None:
    tally = StatusTally(0)
    tally.add(reports.report(1), SECOND_NS)
    soon = tally.message(0, 3 * SECOND_NS // 2, Facts())
    assert (soon.state, soon.localised) == ("tracking", True)
    late = tally.message(1, 5 * SECOND_NS // 2, Facts(camera="silent"))
    assert (late.state, late.localised, late.camera) == ("waiting", False, "silent")


def test_rate_and_latency_are_of_the_time_since_the_last_status() -> None:
    tally = StatusTally(0)
    for index in range(60):
        report = reports.report(index)
        slow = 80.0 if index == 10 else 4.0
        tally.add(replace(report, timing=report.timing._replace(latency=slow)), index)
    first = tally.message(0, 2 * SECOND_NS, Facts())
    assert (first.rate_hz, first.latency_ms, first.uptime_s) == (30.0, 80.0, 2.0)
    tally.add(reports.report(60), 60)
    second = tally.message(1, 4 * SECOND_NS, Facts())
    assert (second.rate_hz, second.latency_ms, second.frames) == (0.5, 4.0, 61)


def test_before_the_first_frame_it_waits() -> None:
    message = StatusTally(0).message(0, 1, Facts(map="hall", camera="starting"))
    assert (message.state, message.localised, message.map) == ("waiting", False, "hall")
    assert message.temperature_c is None
