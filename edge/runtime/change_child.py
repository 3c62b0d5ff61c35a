# SPDX-License-Identifier: Apache-2.0
"""The process that looks for changes beside the tracking: `python -m edge.runtime.change_child FD`.

In a thread it would hold the interpreter for some tens of milliseconds at a look, and whatever the
tracking does between two kernels would wait for it.
"""

import ctypes
import os
import signal
import sys
from multiprocessing.connection import Connection
from pathlib import Path

import cv2

from edge.changes.changes import Changes
from edge.changes.unlabelled import UnlabelledChanges
from edge.errors import EdgeError, TileError
from edge.runtime.change_link import Failed, Found, Order, Ready
from edge.runtime.kernel_cache import use_kernel_cache
from edge.runtime.memory import keep_small
from edge.tiles.reader import open_map

_PR_SET_PDEATHSIG = 1


def main() -> int:
    """Answer looks until nobody sends any."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    keep_small()
    cv2.setNumThreads(1)
    connection: Connection = Connection(int(sys.argv[1]))
    try:
        use_kernel_cache()
        order: Order = connection.recv()
        os.nice(order.nice)
        if order.cpus:
            os.sched_setaffinity(0, order.cpus)
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


def _open(order: Order) -> Changes | UnlabelledChanges:
    map_ = open_map(Path(order.map_folder), resident_bytes=order.resident_bytes)
    if map_.manifest != order.manifest:
        raise TileError(f"{order.map_folder}: has been exchanged meanwhile")
    if order.names is None:
        return UnlabelledChanges(map_, order.camera, order.config)
    return Changes(map_, order.camera, order.names, order.config)


if __name__ == "__main__":
    sys.exit(main())
