# SPDX-License-Identifier: Apache-2.0
"""Where compiled kernels are kept, so that none is ever older than its source.

Numba notices an edited file but not an edited callee or constant in another
file, and would run the old machine code. So the folder's name is a hash of
every file that holds a kernel and of all that those files import.
"""

import hashlib
import logging
import os
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType
from typing import cast

ROOT = Path(__file__).resolve().parents[2]  # the folder that holds the packages
KEPT_CACHES = 4  # newest; older ones go after a day, as a running process may still use one
DAY_S = 86_400
# Parsing all files with `ast` would take a quarter of a second at every start.
HOLDS_KERNEL = re.compile(rb"^@\w*kernel\b", re.MULTILINE)
FROM_IMPORT = re.compile(
    rb"^[ \t]*from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]+)", re.MULTILINE
)
PLAIN_IMPORT = re.compile(rb"^[ \t]*import[ \t]+([^\n]+)", re.MULTILINE)

log = logging.getLogger(__name__)


def use_kernel_cache(parent: Path | None = None) -> Path:
    """Set NUMBA_CACHE_DIR for this process, if it is not set; return the folder.

    Must run before Numba is imported. `parent` is where the folder is made: the
    user's cache by default. Where that cannot be written, kernels are compiled
    anew in each process.
    """
    # Where it is installed Numba loads it, 8 MB, to measure how well its own compiler is tested.
    sys.modules.setdefault("coverage", cast(ModuleType, None))
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(given)
    parent = parent or _user_cache()
    folder = find_kernel_cache(parent)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        _drop_old(parent)
    except OSError:
        folder = Path(tempfile.mkdtemp(prefix="mapvo-kernels-"))
        log.warning(
            "event=kernel_cache_unwritable folder=%s remedy=set NUMBA_CACHE_DIR to a folder "
            "that this user can write",
            parent,
        )
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    return folder


def find_kernel_cache(parent: Path | None = None) -> Path:
    """Where kernels are, or would be, kept; nothing is made or set."""
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(given)
    bounds = "-bounds" if os.environ.get("NUMBA_BOUNDSCHECK", "0") != "0" else ""
    return (parent or _user_cache()) / f"{sources_hash(ROOT)}{bounds}"


def sources_hash(root: Path) -> str:
    """Hash of the kernel files below `root` and of the files that they import."""
    packages = (
        ["edge", "maps", "tools"] if (root / "pyproject.toml").is_file() else ["edge", "maps"]
    )
    sources = {
        path: path.read_bytes() for package in packages for path in (root / package).rglob("*.py")
    }
    open_files = [path for path, text in sources.items() if HOLDS_KERNEL.search(text)]
    closure: set[Path] = set()
    while open_files:
        path = open_files.pop()
        if path not in closure:
            closure.add(path)
            open_files += _imported(sources[path], root, sources)
    digest = hashlib.sha256()
    for path in sorted(closure):
        digest.update(str(path.relative_to(root)).encode() + b"\0" + sources[path] + b"\0")
    return digest.hexdigest()[:16]


def _imported(text: bytes, root: Path, sources: dict[Path, bytes]) -> list[Path]:
    """Files among `sources` that the module imports anywhere in its text."""
    names: set[str] = set()
    for module, listed in FROM_IMPORT.findall(text):
        parts = re.findall(rb"\w+", listed)
        names.add(module.decode())
        names.update(f"{module.decode()}.{part.decode()}" for part in parts)
    for listed in PLAIN_IMPORT.findall(text):
        names.update(name.decode() for name in re.findall(rb"[\w.]+", listed))
    bases = [root.joinpath(*name.split(".")) for name in names]
    paths = [base.with_suffix(".py") for base in bases] + [base / "__init__.py" for base in bases]
    return [path for path in paths if path in sources]


def _user_cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "mapvo" / "kernels"


def _drop_old(parent: Path) -> None:
    modified = {folder: folder.stat().st_mtime for folder in parent.iterdir()}
    newest_first = sorted(modified, key=lambda folder: modified[folder], reverse=True)
    for folder in newest_first[KEPT_CACHES:]:
        if time.time() - modified[folder] > DAY_S:  # noqa: TID251  # file stamps are wall clock
            shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    print(use_kernel_cache())  # noqa: T201  # shell scripts ask for it
