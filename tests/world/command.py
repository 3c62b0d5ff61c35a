# SPDX-License-Identifier: Apache-2.0
"""Runs `mapvo` as its users do."""

import subprocess
import sys
from pathlib import Path

TIMEOUT_S = 900  # kernels may have to be compiled first, on a loaded machine


def mapvo(*arguments: str | Path, cwd: Path | None = None) -> "subprocess.CompletedProcess[str]":
    """One command, run to its end."""
    return subprocess.run(
        command(*arguments), capture_output=True, text=True, timeout=TIMEOUT_S, cwd=cwd, check=False
    )


def command(*arguments: str | Path) -> list[str]:
    """The words of one command."""
    return [sys.executable, "-m", "edge.cli", *map(str, arguments)]


def assert_refused(result: "subprocess.CompletedProcess[str]", *words: str) -> None:
    """One line on stderr that holds all `words`, nothing on stdout, exit status 2."""
    assert result.returncode == 2, result.stderr
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("mapvo")
    for word in words:
        assert word in line, line
