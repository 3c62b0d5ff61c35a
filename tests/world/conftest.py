# SPDX-License-Identifier: Apache-2.0
"""A small simulated room, its map, and a second drive through it; made once for all tests.

Rendering takes half a minute, so the recordings outlive the session: pytest's cache keeps
them under a hash of the simulator's sources. The map is built anew each time.
"""

import hashlib
import shutil
from pathlib import Path
from typing import NamedTuple

import pytest

from maps.build import BuildInput, build
from maps.settings import BuildSettings
from tools.simworld import cli as simworld

COMMON = "--size 320 240 --workers 2"
DRIVES = (  # both begin at about the same place
    f"{COMMON} --drives map --seconds 8",
    f"{COMMON} --drives query --seconds 5",
)


class World(NamedTuple):
    """Folders."""

    map_drive: Path
    query: Path
    map: Path


@pytest.fixture(scope="session")
def world(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> World:
    cache = request.config.cache
    assert cache is not None
    drives = cache.mkdir(f"world-{_simulator_hash()}")
    if not (drives / "complete").exists():
        shutil.rmtree(drives)
        for options in DRIVES:
            assert simworld.main([*options.split(), "--out", str(drives)]) == 0
        (drives / "complete").touch()
    map_folder = tmp_path_factory.mktemp("world") / "map"
    build(BuildInput([drives / "map"]), map_folder, BuildSettings())
    return World(drives / "map", drives / "query", map_folder)


def _simulator_hash() -> str:
    digest = hashlib.sha256(repr(DRIVES).encode())
    for source in sorted(Path(simworld.__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:12]
