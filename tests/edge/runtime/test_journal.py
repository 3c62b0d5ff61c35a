# SPDX-License-Identifier: Apache-2.0
import io
import logging
import os

import pytest

from edge.runtime.journal import JournalFormatter, PatientHandler


def record(level: int, text: str) -> logging.LogRecord:
    return logging.LogRecord("edge.test", level, __file__, 1, text, (), None)


def test_each_line_has_its_priority() -> None:
    formatter = JournalFormatter("%(name)s %(message)s")
    assert formatter.format(record(logging.INFO, "event=ready")) == "<6>edge.test event=ready"
    assert formatter.format(record(logging.ERROR, "a\nb")) == "<3>edge.test a\n<3>b"
    assert formatter.format(record(logging.WARNING, "x")).startswith("<4>")
    assert formatter.format(record(logging.DEBUG, "x")).startswith("<7>")


def test_all_lines_are_out_at_the_end() -> None:
    out = io.StringIO()
    patient = PatientHandler(logging.StreamHandler(out))
    for number in range(500):
        patient.handle(record(logging.INFO, f"line {number}"))
    patient.close()
    patient._thread.join()  # on a busy machine it has more to say than what is waited for
    assert out.getvalue().splitlines() == [f"line {number}" for number in range(500)]
    assert patient.dropped == 0


def test_full_pipe_stops_nobody_and_what_is_lost_is_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(logging, "raiseExceptions", False)
    reader, writer = os.pipe()
    stream = os.fdopen(writer, "w")
    patient = PatientHandler(logging.StreamHandler(stream))
    for _ in range(3000):  # 3 MB: more than the pipe and the queue hold
        patient.handle(record(logging.INFO, 1000 * "x"))
    assert patient.dropped > 1000
    patient.close()  # and so does its end
    os.close(reader)  # the thread that waits for the pipe ends with it
    patient._thread.join()
    try:
        stream.close()
    except BrokenPipeError:
        return
