# SPDX-License-Identifier: Apache-2.0
"""The process that looks for changes beside the tracking: `python -m edge.runtime.change_child FD`.

In a thread it would hold the interpreter for some tens of milliseconds at a look, and whatever the
tracking does between two kernels would wait for it.
"""

import contextlib
import os
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

from edge.child_process import end_with_parent, give_way
from edge.errors import EdgeError, TileError
from edge.runtime.change_link import Failed, Found, Order, Ready
from edge.runtime.kernel_cache import use_kernel_cache
from edge.runtime.memory import keep_small

if TYPE_CHECKING:
    from edge.changes.changes import Changes
    from edge.changes.unlabelled import UnlabelledChanges


def main() -> int:
    """Answer looks until nobody sends any."""
    end_with_parent()
    keep_small()
    connection: Connection = Connection(int(sys.argv[1]))
    try:
        use_kernel_cache()
        order: Order = connection.recv()
        give_way(order.nice)
        _use_cores(order.cpus)
        stage = _open(order)
        connection.send(Ready())
        while True:
            connection.send(Found(stage.step(connection.recv())))
    except (EOFError, BrokenPipeError):
        return 0
    except EdgeError as error:
        connection.send(Failed(str(error)))
    except Exception as error:  # noqa: BLE001  # the process's top: told to the one who waits
        reason = f"{type(error).__name__}: {error}"
        connection.send(Failed(" ".join(reason.split())[:300]))
    return 1


def _use_cores(cpus: tuple[int, ...]) -> None:
    """A preference, too."""
    if cpus:
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, cpus)


def _open(order: Order) -> "Changes | UnlabelledChanges":
    # Numba asks where its cache lies when it is imported: not before `use_kernel_cache`.
    import cv2

    from edge.changes.changes import Changes
    from edge.changes.unlabelled import UnlabelledChanges
    from edge.tiles.reader import open_map

    cv2.setNumThreads(1)
    map_ = open_map(Path(order.map_folder), resident_bytes=order.resident_bytes)
    if map_.manifest != order.manifest:
        raise TileError(f"{order.map_folder}: has been exchanged meanwhile")
    if order.names is None:
        return UnlabelledChanges(map_, order.camera, order.config)
    return Changes(map_, order.camera, order.names, order.config)


if __name__ == "__main__":
    sys.exit(main())
