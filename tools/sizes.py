# SPDX-License-Identifier: Apache-2.0
"""Prints how long files and functions are, and fails where one is too large."""

import ast
import statistics
import subprocess
import sys
from pathlib import Path

MAX_LINES = 300  # a longer module holds two things
MAX_KERNEL_LINES = 500  # kernels unroll by hand, and say the shape of each array
MAX_BYTES = 600_000  # larger files make every clone slow


def tracked_files() -> list[Path]:
    """Files that git knows or would add, in the repository's own order."""
    names = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.splitlines()
    return [path for path in map(Path, names) if path.is_file()]


def function_lengths(tree: ast.Module) -> list[int]:
    """Lines of each function's body, its docstring left out."""
    lengths = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno:
            body = node.body[1:] if ast.get_docstring(node) is not None else node.body
            lengths.append(node.end_lineno - body[0].lineno + 1 if body else 0)
    return lengths


def main() -> int:
    """Print the table; return 1 where a limit is broken."""
    files = tracked_files()
    broken = []
    for package in ("edge", "maps"):
        sources = [path for path in files if path.suffix == ".py" and path.parts[0] == package]
        lines = {path: path.read_text(encoding="utf-8").count("\n") for path in sources}
        functions = [
            length
            for path in sources
            for length in function_lengths(ast.parse(path.read_text(encoding="utf-8")))
        ]
        if not functions:
            continue
        print(
            f"{package}: {len(lines)} files, lines median {statistics.median(lines.values()):.0f}"
            f" max {max(lines.values())}; {len(functions)} functions,"
            f" lines median {statistics.median(functions):.0f} max {max(functions)}"
        )
        for path, count in lines.items():
            limit = MAX_KERNEL_LINES if path.name.startswith("kernels") else MAX_LINES
            if count > limit:
                broken.append(f"{path}: {count} lines, at most {limit} are allowed: part it")
    broken += [
        f"{path}: {path.stat().st_size} bytes, at most {MAX_BYTES} are allowed in the repository"
        for path in files
        if path.stat().st_size > MAX_BYTES
    ]
    print("\n".join(broken), end="\n" if broken else "")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
