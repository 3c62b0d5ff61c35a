# SPDX-License-Identifier: Apache-2.0
import io

from edge.runtime.progress import bar, progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_items_pass_through() -> None:
    assert list(progress(iter("abc"), 3, "letters", Terminal())) == ["a", "b", "c"]


def test_a_terminal_sees_the_bar_and_gets_its_line_back() -> None:
    terminal = Terminal()
    list(progress(range(5), 5, "images", terminal))
    assert "images" in terminal.getvalue()
    assert "5/5" in terminal.getvalue()
    assert terminal.getvalue().endswith("\r\x1b[K")


def test_a_file_sees_nothing() -> None:
    log = io.StringIO()
    list(progress(range(5), 5, "images", log))
    assert log.getvalue() == ""


def test_a_bar_says_how_far_how_fast_and_how_long() -> None:
    line = bar("pairs", 30, 120, 10.0)
    assert line.count("#") == 6
    assert "30/120" in line
    assert "3.0/s" in line
    assert "0:30 left" in line
