# SPDX-License-Identifier: Apache-2.0
"""The plain-text tables of recordings: rows, exact times and their association.

Times never pass through a float64: 19 digits of nanoseconds do not survive it.
"""

import math
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from edge.errors import RecordingError

I64: TypeAlias = NDArray[np.int64]

_MAX_NS = 2**63 - 1
_MAX_S = Decimal(_MAX_NS).scaleb(-9)


class Row(NamedTuple):
    """Cells of one line, and where it stands: for messages."""

    cells: tuple[str, ...]
    where: str

    def time_ns(self, cell: int = 0) -> int:
        """Nanoseconds of a decimal number of seconds, exactly."""
        text = self.cells[cell]
        try:
            seconds = Decimal(text)
        except InvalidOperation:
            raise self.error(f"'{text}' is no time in seconds") from None
        if not seconds.is_finite() or not -_MAX_S <= seconds <= _MAX_S:
            raise self.error(f"time '{text}' is impossible")
        return int((seconds * 10**9).to_integral_value())

    def integer_ns(self, cell: int = 0) -> int:
        """Nanoseconds that stand there as an integer."""
        text = self.cells[cell]
        if not text.isascii() or not text.isdigit() or int(text) > _MAX_NS:
            raise self.error(f"'{text}' is no time in nanoseconds")
        return int(text)

    def numbers(self, first: int, last: int) -> list[float]:
        """Finite numbers of the cells first to last, `last` not included."""
        if len(self.cells) < last:
            raise self.error(f"has {len(self.cells)} columns, {last} are needed")
        try:
            values = [float(cell) for cell in self.cells[first:last]]
        except ValueError as error:
            raise self.error(str(error)) from None
        if not all(map(math.isfinite, values)):
            raise self.error("holds a number that is not finite")
        return values

    def error(self, what: str) -> RecordingError:
        """Error that names this line."""
        return RecordingError(f"{self.where}: {what}; mend or remove the line")


def read_text(path: Path) -> str:
    """Whole text of a file; RecordingError says why it cannot be had."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise RecordingError(f"{path}: is missing; the recording is incomplete") from None
    except UnicodeDecodeError:
        text = "\0"
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    if "\0" in text:
        raise RecordingError(f"{path}: is no text file; copy it anew from its origin")
    return text


def read_rows(path: Path, separator: str | None = None, max_cells: int = 0) -> Iterator[Row]:
    """Rows of a table, without blank lines and comments; the last cell takes the line's rest."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        text = line.strip()
        if text and not text.startswith("#"):
            cells = text.split(separator, max_cells - 1)
            yield Row(tuple(cell.strip() for cell in cells), f"{path} line {number}")


def increasing(times_ns: Sequence[int], rows: Sequence[Row]) -> I64:
    """Times (n,) int64, each after the one before; RecordingError names the first that is not."""
    for before, now, row in zip(times_ns, times_ns[1:], rows[1:], strict=False):
        if now <= before:
            raise row.error("time is not after that of the line before")
    return np.array(times_ns, np.int64)


def nearest(t_ns: I64, others_ns: I64, max_dt_ns: int) -> NDArray[np.int64]:
    """Index (n,) of the nearest of others_ns (m,), increasing, or -1 where none is near enough."""
    if len(others_ns) == 0:
        return np.full(len(t_ns), -1, np.int64)
    after = np.clip(np.searchsorted(others_ns, t_ns), 1, max(1, len(others_ns) - 1))
    low, high = after - 1, np.minimum(after, len(others_ns) - 1)
    closer_low = np.abs(others_ns[low] - t_ns) <= np.abs(others_ns[high] - t_ns)
    index = np.where(closer_low, low, high)
    return np.where(np.abs(others_ns[index] - t_ns) <= max_dt_ns, index, -1)


def a_second_apart(n: int) -> I64:
    """Times (n,) int64 of images that have none."""
    return np.arange(n, dtype=np.int64) * 1_000_000_000


def median_rate_hz(t_ns: I64) -> float | None:
    """Frame rate by the median of the gaps; None with fewer than two frames."""
    return 1e9 / float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else None


def known_rate_hz(stated: float | None, t_ns: I64, file: Path) -> float:
    """Frame rate as `stated` in `file`, else by the frames; RecordingError where neither tells."""
    rate_hz = stated or median_rate_hz(t_ns)
    if rate_hz is None:
        message = "key 'rate_hz' is missing and one frame does not tell it; add it"
        raise RecordingError(f"{file}: {message}")
    return rate_hz
