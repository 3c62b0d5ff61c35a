# SPDX-License-Identifier: Apache-2.0
"""What all commands share: how arguments are read, and how a command ends."""

import argparse
import errno
import io
import math
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TypeAlias

from edge.errors import EdgeError

USER_ERROR = 2
INTERRUPTED = 130  # as shells count Ctrl-C


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line; takes no abbreviations."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **{"allow_abbrev": False} | options)

    def parse_known_args(  # type: ignore[override]  # argparse overloads it by the namespace's type
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Refuse what is left here: the command above, whom argparse gives it, has other help."""
        known, rest = super().parse_known_args(args, namespace)
        rest = self._take_late(known, rest)
        if rest:
            self.error(f"unrecognized arguments: {' '.join(rest)}")
        return known, rest

    def _take_late(self, known: argparse.Namespace, rest: list[str]) -> list[str]:
        """Fill places that may be empty, which argparse closes at the first option."""
        for action in self._get_positional_actions():
            is_open = action.nargs == "?" and getattr(known, action.dest, None) is None
            if is_open and rest and not rest[0].startswith("-"):
                try:
                    setattr(known, action.dest, self._get_value(action, rest[0]))
                except argparse.ArgumentError as error:
                    self.error(str(error))
                rest = rest[1:]
        return rest

    def error(self, message: str) -> NoReturn:
        """Say it and where help is; end with status 2."""
        self.exit(USER_ERROR, f"{self.prog}: {message}; see `{self.prog} --help`\n")


Commands: TypeAlias = "argparse._SubParsersAction[Parser]"


class Stopped(BaseException):
    """Ctrl-C or SIGTERM.

    Not KeyboardInterrupt: where that goes through the start-up code of an extension module,
    the interpreter ends as killed even if it was caught.
    """


def finish(program: str, stopped: str, work: Callable[[], int]) -> int:
    """Do the work; return its status, or what went wrong as one line and its status.

    `stopped` is said after Ctrl-C or SIGTERM. Called in the main thread.
    """
    _print_any_name()
    came: list[int] = []

    def stop(number: int, _frame: FrameType | None) -> None:
        came.append(number)
        sys.unraisablehook = _pass_over
        raise Stopped

    hook = sys.unraisablehook
    usual = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        status = work()
        sys.stdout.flush()
    except EdgeError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return USER_ERROR
    except (Stopped, RuntimeError):  # which Python makes of what goes through a class's start-up
        if not came:
            raise
        print(f"{program}: {stopped}", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        _drop_output()  # who reads it has seen enough
        return 1
    except OSError as error:
        if error.filename is None and error.errno != errno.ENOSPC:
            raise  # of no file: a bug of ours, to be seen in full
        print(f"{program}: {_file_of(error)}: {error.strerror}", file=sys.stderr)
        if error.filename is None:
            _drop_output()
        return USER_ERROR
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
        sys.unraisablehook = hook
    return status


def _pass_over(_unraisable: object) -> None:
    """Say nothing of what fails while it is thrown away: it was stopped half made."""


def _print_any_name() -> None:
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="surrogateescape")  # names of files may be any bytes


def _file_of(error: OSError) -> str:
    return "the output" if error.filename is None else os.fsdecode(error.filename)


def _drop_output() -> None:
    """Keep Python from writing the rest of the output at its end, where that cannot be."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def one_thread_each() -> None:
    """Keep BLAS and OpenMP from making threads: the cores belong to our own."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def span(text: str) -> slice:
    """Range `A:B` of frame numbers; either end may be left out."""
    parts = text.split(":")
    if len(parts) != 2 or not all(part == "" or _is_number(part) for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r} is no range A:B of frame numbers")
    begin, end = (int(part) if part else None for part in parts)
    if begin is not None and end is not None and begin >= end:
        raise argparse.ArgumentTypeError(f"{text!r} holds no frame: A must be below B")
    return slice(begin, end)


def positive(text: str) -> int:
    """Read a whole number from 1 on."""
    if not (_is_number(text) and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number above 0")
    return int(text)


def positive_number(text: str) -> float:
    """Read a finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no number above 0")
    return value


def ending_in(*endings: str) -> Callable[[str], Path]:
    """What reads the name of a file to be written: by its ending it replaces no other kind."""

    def read(text: str) -> Path:
        if not text.lower().endswith(endings):
            raise argparse.ArgumentTypeError(f"{text!r} must end in {' or '.join(endings)}")
        return Path(text)

    return read


picture = ending_in(".png", ".jpg")


def indices(text: str) -> frozenset[int]:
    """Read a list `I,J,...` of whole numbers from 0 on."""
    parts = [part for part in text.split(",") if part]
    if not all(_is_number(part) for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r} is no list of indices I,J,...")
    return frozenset(int(part) for part in parts)


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit()
