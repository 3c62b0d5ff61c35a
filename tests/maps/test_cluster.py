# SPDX-License-Identifier: Apache-2.0
import os
import socket
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import dask
import pytest
from distributed import LocalCluster

from edge.errors import OutputError, RecordingError
from maps.build import BuildInput, build
from maps.cluster import open_cluster
from maps.settings import BuildSettings
from maps.workers import open_workers
from tests.maps.wall_drive import write_wall_drive

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]

SETTINGS = BuildSettings(tile_m=0.3, depth="multiview")
# A loaded machine is slow to answer, not dead.
PATIENT = {
    "distributed.comm.timeouts.connect": "300s",
    "distributed.comm.timeouts.tcp": "300s",
    "distributed.scheduler.worker-ttl": None,
}


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    # Workers are started as others start theirs: they inherit only the environment.
    with (
        dask.config.set(PATIENT),
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
    ):
        yield cluster.scheduler_address


def fail_on(bad: int, number: int) -> int:
    if number == bad:
        raise RecordingError(f"image {number} cannot be read")
    return number * os.getpid() // os.getpid()


def test_a_cluster_builds_the_same_map_as_one_process(scheduler: str, tmp_path: Path) -> None:
    drive = write_wall_drive(tmp_path / "wall")
    build(BuildInput([drive]), tmp_path / "alone", SETTINGS)
    build(BuildInput([drive]), tmp_path / "shared", SETTINGS, dask=scheduler)
    for path in (tmp_path / "alone").rglob("*"):
        other = tmp_path / "shared" / path.relative_to(tmp_path / "alone")
        assert path.is_dir() or path.read_bytes() == other.read_bytes()


def test_results_keep_their_order_and_errors_their_words(scheduler: str) -> None:
    with open_workers(1, scheduler) as workers:
        assert list(workers.map(partial(fail_on, -1), range(40))) == list(range(40))
        with pytest.raises(RecordingError, match="image 7 cannot"):
            list(workers.map(partial(fail_on, 7), range(40)))


def test_an_address_without_a_scheduler_is_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # nobody listens there
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        opening = open_cluster(address, timeout_s=0.5)
        with pytest.raises(OutputError, match=rf"--dask {address}: no scheduler"):
            opening.__enter__()
