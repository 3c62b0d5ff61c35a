# SPDX-License-Identifier: Apache-2.0
"""Loads cached kernels with a third less memory and time than Numba does by itself.

Three things of Numba's that a process which only loads has no use for:

- It keeps the LLVM code of each loaded kernel, in case another one is linked with it:
  some 25 MB for ours. Here it is read again from the cached bytes if that happens.
- Before loading, it registers everything that it could compile: some 10 MB.
- It compiles its own runtime anew in each process, which touches 20 MB of LLVM. Here that
  is kept beside the kernels.

All of that is internal to Numba; its range is pinned for it. Where it is not as expected,
Numba is left as it is.
"""

import hashlib
import logging
import os
import pickle
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numba
from numba.core import caching, codegen
from numba.core.runtime import nrtdynmod, rtsys
from numba.np import linalg

log = logging.getLogger(__name__)

_SECTION = struct.Struct("<IIQQQQIIQQ")  # name, type, flags, address, offset, size, link, ...
_SYMBOL = struct.Struct("<IBBHQQ")  # name, info, other, section, value, size
_SYMBOL_TABLE, _UNDEFINED = 2, 0
_FOR_OTHERS = (1, 2)  # global, weak

_EXPECTED = (
    (codegen.JITCodeLibrary, ("_unserialize", "_get_module_for_linking", "_set_compiled_object")),
    (codegen.JitEngine, ("_load_defined_symbols", "is_symbol_defined")),
    (caching.Cache, ("load_overload", "_load_overload", "_guard_against_spurious_io_errors")),
    (linalg, ("ensure_blas",)),
    (nrtdynmod, ("compile_nrt_functions", "create_nrt_module")),
)


def load_lean() -> None:
    """Change how Numba loads kernels in this process; harmless to call again."""
    missing = [name for owner, names in _EXPECTED for name in names if not hasattr(owner, name)]
    if missing:
        log.warning("event=numba_unknown version=%s lacks=%s", numba.__version__, missing)
        return
    codegen.JITCodeLibrary._unserialize = classmethod(_unserialize)
    codegen.JITCodeLibrary._get_module_for_linking = _get_module_for_linking
    caching.Cache.load_overload = _load_overload
    nrtdynmod.compile_nrt_functions = _runtime_library


def _unserialize(cls: Any, owner: Any, state: Any) -> Any:
    """A library from the cache, without its LLVM code."""
    name, kind, data = state
    if kind != "object":
        return codegen.CPUCodeLibrary._unserialize.__func__(cls, owner, state)
    object_code, bitcode = data
    library = owner.create_library(name)
    library.enable_object_caching()
    library._set_compiled_object(object_code)
    library._finalize_final_module()
    owner._engine._defined_symbols.update(defined_symbols(object_code))
    library._bitcode = bitcode
    return library


def defined_symbols(object_code: bytes) -> list[str]:
    """Names that a 64-bit ELF object file defines for others.

    Numba asks the LLVM code for them, which takes 20 MB to parse for one of our kernels.
    """
    if object_code[:6] != b"\x7fELF\x02\x01":
        raise ValueError("no little-endian 64-bit ELF object")
    (offset,) = struct.unpack_from("<Q", object_code, 0x28)
    entry_bytes, count = struct.unpack_from("<HH", object_code, 0x3A)
    if count == 0:  # too many for the header: the first section says it
        count = _SECTION.unpack_from(object_code, offset)[5]
    sections = [_SECTION.unpack_from(object_code, offset + i * entry_bytes) for i in range(count)]
    names = []
    for section in sections:
        if section[1] != _SYMBOL_TABLE:
            continue
        at, size, strings = section[4], section[5], sections[section[6]][4]
        for name, info, _, where, _, _ in _SYMBOL.iter_unpack(object_code[at : at + size]):
            if where != _UNDEFINED and info >> 4 in _FOR_OTHERS:
                begin = strings + name
                names.append(object_code[begin : object_code.index(b"\0", begin)].decode())
    return names


def _get_module_for_linking(library: Any) -> Any:
    bitcode = library.__dict__.pop("_bitcode", None)
    if bitcode is not None:
        library._shared_module = llvm.parse_bitcode(bitcode)
    return codegen.CPUCodeLibrary._get_module_for_linking(library)


def _load_overload(cache: Any, signature: Any, target_context: Any) -> Any:
    rtsys.initialize(target_context)
    with _without_scipy(), cache._guard_against_spurious_io_errors():
        return cache._load_overload(signature, target_context)


@contextmanager
def _without_scipy() -> Iterator[None]:
    """Let numba.np.arraymath, if it is imported here, not import scipy.linalg: 15 MB.

    Code that calls a BLAS finds it by itself.
    """
    ensure_blas = linalg.ensure_blas
    linalg.ensure_blas = _nothing
    try:
        yield
    finally:
        linalg.ensure_blas = ensure_blas


def _nothing() -> None:
    pass


def _runtime_library(target_context: Any) -> Any:
    """Numba's runtime: from the cache, or compiled and put there."""
    owner = target_context.codegen()
    path = _runtime_file(owner)
    if path is not None and (state := _read(path)) is not None:
        return owner.unserialize_library(state)
    ir_module, library = nrtdynmod.create_nrt_module(target_context)
    library.enable_object_caching()
    library.add_ir_module(ir_module)
    library.finalize()
    if path is not None:
        _write(path, library.serialize_using_object_code())
    return library


def _runtime_file(owner: Any) -> Path | None:
    """Where it is kept, for this version and this processor; None without a cache folder."""
    folder = os.environ.get("NUMBA_CACHE_DIR")
    if not folder:
        return None
    what = repr((numba.__version__, llvmlite.__version__, owner.magic_tuple()))
    return Path(folder) / f"runtime-{hashlib.sha256(what.encode()).hexdigest()[:16]}.bin"


def _read(path: Path) -> Any:
    """The state of a library; None where there is none, or a damaged one."""
    try:
        checksum, _, body = path.read_bytes().partition(b"\n")
    except OSError:
        return None
    if hashlib.sha256(body).hexdigest().encode() != checksum:
        return None
    return pickle.loads(body)


def _write(path: Path, state: Any) -> None:
    """Keep it if the folder takes it; another process may do the same just now."""
    body = pickle.dumps(state)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(hashlib.sha256(body).hexdigest().encode() + b"\n" + body)
        Path(file.name).replace(path)
    except OSError as error:
        log.debug("event=runtime_not_kept %s", error)
