# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.cameras import tables
from edge.errors import RecordingError


def row(*cells: str) -> tables.Row:
    return tables.Row(cells, "rgb.txt line 3")


@pytest.mark.parametrize(
    ("text", "t_ns"),
    [
        ("1403715273.262143", 1403715273262143000),
        ("1403715273.262142976", 1403715273262142976),
        ("1.036224e-01", 103622400),
        ("0", 0),
        ("0.000000001", 1),
        ("-2.5", -2500000000),
        ("9223372036.854775807", 2**63 - 1),
    ],
)
def test_seconds_become_nanoseconds_exactly(text: str, t_ns: int) -> None:
    assert row(text).time_ns() == t_ns


@pytest.mark.parametrize("text", ["abc", "nan", "inf", "1e30", "1e999999", "", "12,5"])
def test_what_is_no_time_is_named(text: str) -> None:
    with pytest.raises(RecordingError, match=r"rgb\.txt line 3: .*time"):
        row(text).time_ns()


def test_zeros_in_a_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / "rgb.txt").write_bytes(b"0.1 rgb/0\0.png\n")
    with pytest.raises(RecordingError, match=r"rgb\.txt: is no text file"):
        tables.read_text(tmp_path / "rgb.txt")


def test_integers_keep_all_digits() -> None:
    assert row("1403715273262142976").integer_ns() == 1403715273262142976


@pytest.mark.parametrize("text", ["1.5", "-3", "x", "", "99999999999999999999", "²"])
def test_what_is_no_integer_time_is_named(text: str) -> None:
    with pytest.raises(RecordingError, match=r"line 3: .*nanoseconds"):
        row(text).integer_ns()


@pytest.mark.parametrize(
    ("cells", "word"),
    [
        (("1", "2"), "2 columns, 3 are needed"),
        (("1", "x", "2"), "'x'"),
        (("1", "nan", "2"), "finite"),
    ],
)
def test_bad_numbers_are_named(cells: tuple[str, ...], word: str) -> None:
    with pytest.raises(RecordingError, match=word):
        row(*cells).numbers(0, 3)


def test_rows_leave_out_comments_and_know_their_line(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_bytes("\ufeff# time path\r\n\r\n1.0  a b.png \r\n".encode())
    (only,) = tables.read_rows(path, max_cells=2)

    assert only.cells == ("1.0", "a b.png")
    assert only.where == f"{path} line 3"


def test_files_that_are_no_text_are_named(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(b"\xff\xd8\xff")

    with pytest.raises(RecordingError, match="missing: is missing"):
        tables.read_text(tmp_path / "missing")
    with pytest.raises(RecordingError, match="binary: is no text"):
        tables.read_text(tmp_path / "binary")
    with pytest.raises(RecordingError, match="cannot be read"):
        tables.read_text(tmp_path)


@pytest.mark.parametrize("times", [[1, 1], [2, 1]])
def test_times_must_increase(times: list[int]) -> None:
    with pytest.raises(RecordingError, match="line 3: time is not after"):
        tables.increasing(times, [row("1"), row("1")])


def test_nearest_takes_the_nearest_and_nothing_too_far() -> None:
    t_ns = np.array([0, 90, 111, 250, 1000])
    others = np.array([100, 120, 240])

    assert tables.nearest(t_ns, others, 20).tolist() == [-1, 0, 1, 2, -1]
    assert tables.nearest(t_ns, others[:1], 20).tolist() == [-1, 0, 0, -1, -1]
    assert tables.nearest(t_ns, others[:0], 20).tolist() == [-1] * 5


def test_rate_is_that_of_the_usual_gap() -> None:
    assert tables.median_rate_hz(np.array([0, 50, 100, 900]) * 10**6) == pytest.approx(20.0)
    assert tables.median_rate_hz(np.array([5])) is None
