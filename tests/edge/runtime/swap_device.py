# SPDX-License-Identifier: Apache-2.0
"""A device with a store of maps, and a daemon that takes whatever it is given."""

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import msgspec

from edge.config import Config
from edge.config.tiles import TilesConfig
from edge.geometry.camera import CameraModel
from edge.runtime.map_switch import Localised, SwapRefused
from edge.runtime.swap import TileKeeper
from edge.store.records import Generation
from edge.store.store import Store
from tests.edge.store.made_bundles import RUNTIME, Workstation

CAMERA = CameraModel(320, 240, 280.0, 280.0, 159.5, 119.5)
LONG_S = 60.0


class Host:
    """A daemon that uses any map, but for those of refused folders."""

    def __init__(self, folder: Path | None) -> None:
        self.map_folder = folder
        self.told: list[str] = []
        self.counts = Localised(0, 0)
        self.counts_after: Localised | None = None  # from the next swap on
        self.refusal = ""
        self.rehearsed: list[bool] = []

    def swap(self, map_folder: Path, rehearse: bool = True) -> None:
        if self.refusal:
            raise SwapRefused(self.refusal)
        self.rehearsed.append(rehearse)
        self.map_folder = map_folder
        self.counts = self.counts_after or self.counts

    def localised(self) -> Localised:
        return self.counts

    def tell(self, text: str) -> None:
        self.told.append(text)


class Device:
    """A store with generation 1 in use, and the daemon that uses it."""

    def __init__(self, folder: Path, bench: Workstation, **settings: float) -> None:
        self.bench = bench
        self.store = Store(folder / "store")
        first = self.install(1)
        self.store.activate(first)
        self.store.mark_good(first)
        self.host = Host(self.store.map_folder(first))
        usual = {"good_after_s": 3600.0, "rescan_s": 0.05, **settings}
        tiles = TilesConfig(
            store=str(self.store.root),
            keys=str(bench.folder / "trusted"),
            keep_free_mb=0,
            **usual,  # type: ignore[arg-type]
        )
        self.config = msgspec.structs.replace(Config(), tiles=tiles)

    def install(self, version: int) -> Generation:
        with self.bench.open(self.bench.bundle(version)) as bundle:
            return self.store.install(bundle, RUNTIME)

    @contextmanager
    def keeper(self) -> Iterator[TileKeeper]:
        made = TileKeeper(self.config, self.store, self.host, self.host.swap, CAMERA)
        with closing(made) as keeper:
            yield keeper

    def drop_map(self, keeper: TileKeeper) -> None:
        """What the daemon does once it finds its map damaged."""
        folder, self.host.map_folder = self.host.map_folder, None
        assert folder is not None
        keeper.return_from_damage(folder)

    def drop(self, version: int) -> Path:
        """Put a bundle into the inbox; return the file of the answer."""
        path = self.bench.bundle(version)
        target = self.store.inbox / path.name
        target.write_bytes(path.read_bytes())
        return target.with_name(path.name + ".result.txt")


def until(what: Callable[[], bool]) -> None:
    deadline = time.monotonic() + LONG_S
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.01)
