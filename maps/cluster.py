# SPDX-License-Identifier: Apache-2.0
"""A Dask cluster as workers of a build.

The cluster's machines see the recordings under the same paths, and run the same versions on the
same kind of processor: then the map is the same to the byte as one that was built without them.
"""

import importlib.metadata
import logging
import platform
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from edge.errors import EdgeError, OutputError
from edge.runtime.kernel_cache import ROOT, sources_hash, use_kernel_cache

try:
    from distributed import Client
except ImportError:
    raise OutputError(
        "--dask needs the packages dask and distributed; install mapvo[dask]"
    ) from None

A = TypeVar("A")
B = TypeVar("B")

_PACKAGES = ("mapvo", "numpy", "numba", "scipy", "opencv-python-headless")
_AHEAD = 4  # items for each thread of the cluster that are sent before their results are taken


class _Cluster:
    def __init__(self, client: Any) -> None:
        self._client = client

    def map(self, function: Callable[[A], B], items: Sequence[A]) -> Iterator[B]:
        """Results of all items, in their order; a bounded number is under way."""
        ahead = _AHEAD * max(1, sum(self._client.nthreads().values()))
        waiting: deque[Any] = deque()
        left = iter(items)
        try:
            for _ in items:
                while len(waiting) < ahead and (item := next(left, _NONE)) is not _NONE:
                    waiting.append(self._client.submit(function, item, pure=False))
                yield self._take(waiting.popleft())
        finally:
            self._client.cancel(list(waiting))

    def _take(self, future: Any) -> Any:
        try:
            return future.result()
        except EdgeError:
            raise
        except Exception as error:
            if type(error).__module__.startswith("distributed"):
                message = f"the Dask cluster failed ({error}); look at its workers' logs"
                raise OutputError(message) from None
            raise


_NONE = object()


@contextmanager
def open_cluster(address: str, timeout_s: float = 20.0) -> Iterator[_Cluster]:
    """Give the cluster of the scheduler at `address`, once its workers turn out to be like us."""
    logging.getLogger("distributed").setLevel(logging.ERROR)
    try:
        client = Client(  # type: ignore[no-untyped-call]  # distributed has few types
            address, timeout=timeout_s, set_as_default=False
        )
    except (OSError, TimeoutError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else "no answer"
        raise OutputError(f"--dask {address}: no scheduler can be reached ({reason})") from None
    with client:
        _check_workers(client, address, timeout_s)
        yield _Cluster(client)


def _check_workers(client: Any, address: str, timeout_s: float) -> None:
    try:
        client.wait_for_workers(1, timeout=timeout_s)
    except TimeoutError:
        raise OutputError(f"--dask {address}: the cluster has no workers; start some") from None
    own = describe_worker()
    for worker, other in client.run(describe_worker, on_error="return").items():
        if isinstance(other, BaseException):
            raise OutputError(f"--dask {address}: worker {worker} has no mapvo ({other})")
        for what, value in own.items():
            if other.get(what) != value:
                raise OutputError(
                    f"--dask {address}: worker {worker} has {what} {other.get(what)}, this machine "
                    f"{value}; the map would differ, so make them the same"
                )


def describe_worker() -> dict[str, str]:
    """What a worker must have in common with us; it begins to keep compiled kernels, too."""
    use_kernel_cache()
    found = {name: importlib.metadata.version(name) for name in _PACKAGES}
    return {**found, "Python": platform.python_version(), "sources": sources_hash(ROOT)}
