# SPDX-License-Identifier: Apache-2.0
import ast
from pathlib import Path

import pytest

PACKAGES = Path(__file__).parents[2]
KERNEL_FILES = sorted(
    path for package in ("edge", "maps") for path in (PACKAGES / package).rglob("kernels*.py")
)
ALLOWED = {"math", "typing", "numpy", "numba", "edge", "maps", "__future__"}


def imported(path: Path) -> set[str]:
    """Modules that the file imports, in full."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


@pytest.mark.parametrize("path", KERNEL_FILES, ids=lambda path: str(path.relative_to(PACKAGES)))
def test_kernels_compute_and_do_nothing_else(path: Path) -> None:
    assert {name.partition(".")[0] for name in imported(path)} <= ALLOWED
