# SPDX-License-Identifier: Apache-2.0
"""Kernel caches that survive a power cut: a torn file is compiled anew, not believed.

Numba trusts its cached files. One that a power cut or a full disk left empty or half zeroed would
end each start with a traceback, or run as machine code. Here each begins with a checksum; they are
not synced one by one, since all that a loss costs is compiling.

Internal to Numba, as is `edge/kernel_loading.py`; where it is not as expected it is left as it is.
"""

import errno
import logging
import pickle
import zlib
from pathlib import Path
from typing import Any

import numba
from numba.core import caching

log = logging.getLogger(__name__)

_EXPECTED = ("_load_index", "_save_index", "_load_data", "_save_data", "_dump", "_open_for_write")
_CHECKSUM_BYTES = 4
# Part of the checksum, so that what another Numba wrote is never unpickled.
_VERSION = zlib.crc32(numba.__version__.encode())


def distrust() -> None:
    """Let Numba check its cached files in this process; harmless to call again."""
    missing = [name for name in _EXPECTED if not hasattr(caching.IndexDataCacheFile, name)]
    if missing:
        log.warning("event=numba_unknown version=%s lacks=%s", numba.__version__, missing)
    elif not issubclass(caching.IndexDataCacheFile, _CheckedFiles):
        caching.IndexDataCacheFile = _CheckedFiles


class _CheckedFiles(caching.IndexDataCacheFile):  # type: ignore[misc]  # numba ships no types
    """Index and data files of one kernel, each with a checksum before it."""

    def save(self, key: Any, data: Any) -> None:
        """Keep a compiled kernel, if the disk takes it."""
        try:
            super().save(key, data)
        except OSError as error:
            log.warning("event=kernel_not_kept file=%s: %s", self._index_path, error.strerror)

    def _load_index(self) -> Any:
        content = _read(Path(self._index_path))
        if content is None:
            return {}
        stamp, overloads = pickle.loads(content)
        return overloads if stamp == self._source_stamp else {}

    def _save_index(self, overloads: Any) -> None:
        self._write(self._index_path, self._dump((self._source_stamp, overloads)))

    def _load_data(self, name: str) -> Any:
        path = self._data_path(name)
        content = _read(Path(path))
        if content is None:  # taken by the caller as if it were not there
            raise OSError(errno.EIO, "missing or damaged", path)
        return pickle.loads(content)

    def _save_data(self, name: str, data: Any) -> None:
        self._write(self._data_path(name), self._dump(data))

    def _write(self, path: str, content: bytes) -> None:
        with self._open_for_write(path) as file:
            file.write(zlib.crc32(content, _VERSION).to_bytes(_CHECKSUM_BYTES, "little"))
            file.write(content)


def _read(path: Path) -> bytes | None:
    """What was written there; None where that is not whole, or nothing is there."""
    try:
        whole = path.read_bytes()
    except FileNotFoundError:
        return None
    checksum, content = whole[:_CHECKSUM_BYTES], whole[_CHECKSUM_BYTES:]
    if int.from_bytes(checksum, "little") == zlib.crc32(content, _VERSION) and content:
        return content
    log.info("event=kernel_file_damaged file=%s: compiled anew", path)
    return None
