# SPDX-License-Identifier: Apache-2.0
import threading
from pathlib import Path

import pytest

from edge.errors import TileError
from edge.runtime.live import OpenedMap
from edge.runtime.map_switch import MapSwitch, SwapRefused
from edge.runtime.search import NoSearch, Search
from edge.runtime.warm_up import MAP_FOLDER
from edge.tiles.reader import open_map

OLD = NoSearch()


class Opener:
    """Opens every folder as the map that comes with the package."""

    def __init__(self) -> None:
        self.searches: list[ClosableSearch] = []

    def __call__(self, folder: Path) -> OpenedMap:
        if folder.name == "bad":
            raise TileError(f"{folder}: damaged")
        self.searches.append(ClosableSearch())
        map_ = open_map(MAP_FOLDER)
        return OpenedMap(map_, self.searches[-1], map_.cameras[0])


class ClosableSearch(NoSearch):
    closed = False

    def close(self) -> None:
        self.closed = True


def test_swap_returns_when_the_tracking_has_taken_the_map() -> None:
    opener, old = Opener(), ClosableSearch()
    switch = MapSwitch(opener, timeout_s=60.0)
    asker = threading.Thread(target=switch.swap, args=(Path("new"),))
    asker.start()
    used: list[OpenedMap] = []

    def use(opened: OpenedMap) -> Search:
        used.append(opened)
        return old

    while not switch.apply(use):
        assert not old.closed
    asker.join()
    assert [item.search for item in used] == opener.searches
    assert old.closed
    assert not opener.searches[0].closed
    assert not switch.apply(use)


def test_map_that_cannot_be_opened_changes_nothing() -> None:
    switch = MapSwitch(Opener())
    with pytest.raises(TileError):
        switch.swap(Path("bad"))
    assert not switch.apply(lambda _: OLD)


def test_swap_that_nobody_takes_is_refused_and_freed() -> None:
    opener = Opener()
    switch = MapSwitch(opener, timeout_s=0.01)
    with pytest.raises(SwapRefused, match="not put in"):
        switch.swap(Path("new"))
    assert opener.searches[0].closed
    assert not switch.apply(lambda _: OLD)


def test_who_waits_is_told_when_the_tracking_ends() -> None:
    opener, said = Opener(), []
    switch = MapSwitch(opener, timeout_s=3600.0)

    def ask() -> None:
        with pytest.raises(SwapRefused) as refused:
            switch.swap(Path("new"))
        said.append(str(refused.value))

    asker = threading.Thread(target=ask)
    asker.start()
    switch.close()
    asker.join()
    assert said == ["new: not put in: the program ends"]
    assert opener.searches[0].closed


def test_swaps_from_several_threads_come_one_by_one() -> None:
    opener = Opener()
    switch = MapSwitch(opener, timeout_s=60.0)
    askers = [threading.Thread(target=switch.swap, args=(Path(f"{n}"),)) for n in range(4)]
    for asker in askers:
        asker.start()
    in_use: list[Search] = [ClosableSearch()]

    def use(opened: OpenedMap) -> Search:
        in_use.append(opened.search)
        return in_use[-2]

    while len(in_use) < 5:
        switch.apply(use)
    for asker in askers:
        asker.join()
    assert [search.closed for search in opener.searches] == [True, True, True, False]
