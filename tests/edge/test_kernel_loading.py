# SPDX-License-Identifier: Apache-2.0
"""Kernels from the cache are loaded without what Numba keeps beside them."""

import os
import subprocess
import sys
from pathlib import Path

import llvmlite.binding as llvm
import pytest

from edge.kernel_loading import defined_symbols, load_lean

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif("NUMBA_DISABLE_JIT" in os.environ, reason="nothing is compiled"),
]

# `outer` is compiled anew where MAPVO_ANEW is set, and then linked with the loaded `inner`.
KERNELS = """
import os
import numpy as np
from edge.kernel import kernel

@kernel
def inner(values, out):
    for i in range(values.shape[0]):
        out[i] = 2.0 * values[i] + np.sum(values)
    return values[1]

if os.environ.get("MAPVO_ANEW"):
    @kernel
    def outer(values, out):
        return inner(values, out) + 1000.0
else:
    @kernel
    def outer(values, out):
        return inner(values, out) + 1.0
"""
USE = """
import resource, sys
import numpy as np
from numba.core import event
from kernels_made import inner, outer
compiled = []
class Names(event.Listener):
    def on_start(self, e): compiled.append(e.data["dispatcher"].py_func.__name__)
    def on_end(self, e): pass
with event.install_listener("numba:compile", Names()):
    values, out = np.array([1.0, 2.0, 6.0]), np.zeros(3)
    results = [inner(values, out), *out.tolist(), outer(values, out)]
print(results, ",".join(compiled), "scipy.linalg" in sys.modules)
"""


def run(folder: Path, **environment: str) -> list[str]:
    """What a process of its own prints: results, and the names of what it compiled."""
    (folder / "kernels_made.py").write_text(KERNELS)
    (folder / "use.py").write_text(USE)
    root = Path(__file__).parents[2]
    result = subprocess.run(
        [sys.executable, "use.py"],
        cwd=folder,
        env=os.environ
        | {"NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": str(root)}
        | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return result.stdout.split("] ")


def compiled(rest: str) -> set[str]:
    return set(rest.split(" ")[0].split(","))


def test_loaded_kernels_work_as_compiled_ones_and_can_be_linked_with(tmp_path: Path) -> None:
    results, rest = run(tmp_path)
    assert results == "[2.0, 11.0, 13.0, 21.0, 3.0"
    assert {"inner", "outer"} <= compiled(rest)
    assert run(tmp_path) == [results, " False\n"]  # all loaded, and no SciPy with it
    anew, rest = run(tmp_path, MAPVO_ANEW="1")
    assert anew == "[2.0, 11.0, 13.0, 21.0, 1002.0"
    assert "outer" in compiled(rest)
    assert "inner" not in compiled(rest)


def test_damaged_runtime_library_is_made_again(tmp_path: Path) -> None:
    run(tmp_path)
    (kept,) = (tmp_path / "cache").glob("runtime-*.bin")
    whole = kept.read_bytes()
    for damaged in (whole[:-100], whole.replace(b"NRT", b"XXX", 1)):
        kept.write_bytes(damaged)
        assert run(tmp_path)[0] == "[2.0, 11.0, 13.0, 21.0, 3.0"
        assert kept.read_bytes()[:64] == whole[:64]
    assert [file.name for file in (tmp_path / "cache").iterdir() if file.is_file()] == [kept.name]


def test_torn_kernels_are_compiled_again(tmp_path: Path) -> None:
    results, _ = run(tmp_path)
    kept = [*(tmp_path / "cache").rglob("*.nbi"), *(tmp_path / "cache").rglob("*.nbc")]
    for number, path in enumerate(kept):
        path.write_bytes(path.read_bytes()[: 2000 * (number % 2)])
    again, rest = run(tmp_path)
    assert again == results
    assert {"inner", "outer"} <= compiled(rest)


def test_symbols_are_those_that_the_object_defines() -> None:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    module = llvm.parse_assembly(
        """
        @table = global i32 7
        @hidden = internal global i32 8
        @elsewhere = external global i32
        define i32 @visible() { %a = load i32, ptr @hidden %b = load i32, ptr @elsewhere
          %c = add i32 %a, %b ret i32 %c }
        define linkonce_odr i32 @weak() { ret i32 2 }
        define i32 @user() { %a = call i32 @weak() ret i32 %a }
        declare i32 @missing()
        """
    )
    machine = llvm.Target.from_default_triple().create_target_machine()
    names = defined_symbols(machine.emit_object(module))
    assert sorted(names) == ["table", "user", "visible", "weak"]


def test_what_is_no_object_is_refused() -> None:
    with pytest.raises(ValueError, match="ELF"):
        defined_symbols(b"MZ" + bytes(100))


def test_numba_is_as_expected(caplog: pytest.LogCaptureFixture) -> None:
    load_lean()
    assert "numba_unknown" not in caplog.text
