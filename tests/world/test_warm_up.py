"""After warm-up no run may wait for a kernel."""

import subprocess
import sys

import pytest

from tests.world.conftest import World

pytestmark = [pytest.mark.world, pytest.mark.slow]

PROGRAM = """
import gc, sys, tempfile
from pathlib import Path
from numba.core.registry import CPUDispatcher
from edge.config import Config
from edge.runtime.replay import ReplayJob, replay
from edge.runtime.warm_up import warm_up


def variants():
    kernels = [o for o in gc.get_objects() if isinstance(o, CPUDispatcher)]
    return {
        (kernel.py_func.__module__, kernel.py_func.__qualname__, str(signature))
        for kernel in kernels
        for signature in kernel.signatures
    }


recording, map_folder = map(Path, sys.argv[1:])
warm_up(Config())
warm = variants()
assert len(warm) > 10
for options in ({}, {"realtime": True}, {"reverse": True, "stride": 2}, {"map_folder": None}):
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        replay(ReplayJob(recording, out, **{"map_folder": map_folder, **options}), Config())
for module, name, signature in sorted(variants() - warm):
    print(f"{module}.{name}{signature}")
"""


def test_warm_up_leaves_no_kernel_variant_out(world: World) -> None:
    """Counts variants in memory, so that a full cache on disk hides nothing."""
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(world.query), str(world.map)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout == ""
