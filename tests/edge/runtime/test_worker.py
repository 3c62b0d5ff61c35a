# SPDX-License-Identifier: Apache-2.0
import threading
from pathlib import Path

import pytest

from edge.errors import RecordingError
from edge.runtime.worker import Worker


def test_failure_is_raised_where_it_is_asked_for() -> None:
    def work() -> None:
        raise RecordingError("film torn")

    worker = Worker("test", work)
    worker.join()
    with pytest.raises(RecordingError, match="film torn"):
        worker.check()


def test_bug_is_logged_and_raised(caplog: pytest.LogCaptureFixture) -> None:
    def work() -> None:
        raise ZeroDivisionError

    worker = Worker("sums", work)
    worker.join()
    with pytest.raises(ZeroDivisionError):
        worker.check()
    assert "thread_died name=sums" in caplog.text


def test_good_end_is_silent() -> None:
    done = []
    worker = Worker("test", lambda: done.append(1))
    worker.join()
    worker.check()
    assert done == [1]


def test_thread_is_called_by_its_name_outside_python_too() -> None:
    names: list[str] = []

    def work() -> None:
        task = f"/proc/self/task/{threading.get_native_id()}/comm"
        names.append(Path(task).read_text().strip())

    Worker("a-rather-long-name", work).join()
    assert names == ["a-rather-long-n"]
