# SPDX-License-Identifier: Apache-2.0
"""The search for changes in a process of its own finds what it finds here, and may die."""

import os
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from edge.changes.changes import Changes
from edge.config.changes import ChangesConfig
from edge.runtime import change_process
from edge.runtime.change_link import Order
from edge.runtime.change_process import ChangeProcess
from edge.tiles.reader import Map
from edge.types import Look
from tests.edge.changes.scenes import NOTHING
from tests.edge.changes.wall_map import CUP, N_VIEWS, NAMES, make_labelled, shown
from tests.maps.wall_drive import CAMERA, poses

pytestmark = pytest.mark.slow

HOUR_NS = 3_600_000_000_000


class Clock:
    """Stands still unless it is told to go on: a slow machine is never too slow."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        return self.now_ns


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> Map:
    return make_labelled(tmp_path_factory.mktemp("changes"))


def order(map_: Map) -> Order:
    return Order(
        map_folder=str(map_.folder),
        manifest=map_.manifest,
        resident_bytes=1 << 24,
        camera=CAMERA,
        names=tuple(NAMES),
        config=ChangesConfig(),
        nice=1,
        cpus=(),
    )


def looks() -> Iterator[Look]:
    """Views of the wall, in which the model sees nothing."""
    for i, T in enumerate(poses(N_VIEWS)):
        yield Look(i, i * 200_000_000, shown(T, []), T, np.empty((0, 3)), NOTHING)


def test_it_tells_what_the_search_tells_here(labelled: Map) -> None:
    here = Changes(labelled, CAMERA, NAMES, ChangesConfig())
    process = ChangeProcess(order(labelled))

    told = [(event, other) for look in looks() for event, other in _both(here, process, look)]
    process.close()

    ((event, other),) = told
    assert event.kind == other.kind == "removed"
    assert np.linalg.norm(event.center_map_m - CUP[1]) < 0.02
    assert event.log_odds == other.log_odds
    assert event.t_ns == other.t_ns
    assert process.reason == ""


def _both(here: Changes, there: ChangeProcess, look: Look):  # type: ignore[no-untyped-def]
    return zip(here.step(look), there.step(look), strict=True)


def test_killed_it_starts_anew_after_a_wait_and_says_so(labelled: Map) -> None:
    clock = Clock()
    process = ChangeProcess(order(labelled), clock=clock)
    look = next(looks())
    process.step(look)
    first = process.pid

    os.kill(first, signal.SIGKILL)
    assert process.step(look) == []
    assert "the search for changes ended" in process.reason
    assert process.step(look) == []
    assert process.pid == 0  # not before its time
    clock.now_ns += HOUR_NS
    assert process.step(look) == []
    assert process.pid not in (0, first)
    assert process.reason == ""
    assert process.restarts == 1
    process.close()


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("raise SystemExit(7)", "ended"),
        ("c.recv(); c.send(Failed('no luck'))", "failed: no luck"),
        ("c.recv(); import os; os.write(int(sys.argv[1]), b'nonsense' * 9)", "ended"),
        ("c.recv(); c.send_bytes(b'nonsense')", "answered nonsense"),
    ],
)
def test_a_process_that_misbehaves_costs_changes_only(
    script: str, said: str, labelled: Map
) -> None:
    prelude = (
        "import sys; from multiprocessing.connection import Connection;"
        "from edge.runtime.change_link import Failed; c = Connection(int(sys.argv[1]));"
    )
    process = ChangeProcess(order(labelled), (sys.executable, "-c", prelude + script), Clock())

    assert process.step(next(looks())) == []

    assert said in process.reason
    assert process.pid == 0


def test_one_that_hangs_is_ended(labelled: Map) -> None:
    clock = Clock()
    command = (sys.executable, "-c", "import time; time.sleep(999)")
    process = ChangeProcess(order(labelled), command, clock)

    def go_on() -> bool:
        clock.now_ns += HOUR_NS  # it passes while it is waited for
        return True

    assert process.step(next(looks()), go_on) == []
    assert "did not answer in time" in process.reason
    assert process.pid == 0


def test_one_that_reads_no_more_is_ended(labelled: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(change_process, "_LONGEST_SEND_S", 1.0)
    process = ChangeProcess(order(labelled), clock=Clock())
    look = next(looks())
    process.step(look)
    os.kill(process.pid, signal.SIGSTOP)

    large = replace(look, image=np.zeros((1000, 1000), np.uint8))  # more than a socket holds
    assert process.step(large) == []

    assert "took no image in time" in process.reason
    assert process.pid == 0


def test_a_map_that_has_been_exchanged_is_not_searched(labelled: Map) -> None:
    manifest = msgspec.structs.replace(labelled.manifest, metric=not labelled.manifest.metric)
    process = ChangeProcess(order(labelled)._replace(manifest=manifest), clock=Clock())

    assert process.step(next(looks())) == []

    assert "has been exchanged" in process.reason
    assert process.pid == 0


def test_whoever_waits_for_an_answer_can_give_up(labelled: Map) -> None:
    process = ChangeProcess(order(labelled), clock=Clock())

    assert process.step(next(looks()), lambda: False) == []

    assert process.pid == 0
    assert process.reason == ""
