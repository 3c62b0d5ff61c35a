# SPDX-License-Identifier: Apache-2.0
"""After warm-up no run may wait for a kernel."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.world.conftest import World

pytestmark = [pytest.mark.world, pytest.mark.slow]

PROGRAM = """
import gc, sys, tempfile
from pathlib import Path
import msgspec
from numba.core.registry import CPUDispatcher
from edge.config import Config
from edge.runtime.replay import ReplayJob, replay
from edge.runtime.swap_selftest import choose_held_out, find_held_out
from edge.runtime.warm_up import warm_up
from edge.tiles.reader import open_map


def variants():
    gc.unfreeze()  # a run freezes what it starts with, which is hidden then
    kernels = [o for o in gc.get_objects() if isinstance(o, CPUDispatcher)]
    return {
        (kernel.py_func.__module__, kernel.py_func.__qualname__, str(signature))
        for kernel in kernels
        for signature in kernel.signatures
    }


recording, map_folder, distorted = map(Path, sys.argv[1:])
usual_config = msgspec.convert({"outputs": {"zmq": {"endpoint": "ENDPOINT"}}}, Config)
warm_up(Config())
warm = variants()
assert len(warm) > 10
for options in (
    {},
    {"realtime": True},
    {"reverse": True, "stride": 2},
    {"map_folder": None},
    {"recording": distorted},
):
    with tempfile.TemporaryDirectory() as folder:
        usual = {"recording": recording, "map_folder": map_folder, "out": Path(folder) / "run"}
        replay(ReplayJob(**{**usual, **options}), usual_config)
map_ = open_map(map_folder)
find_held_out(map_, choose_held_out(map_.n_keyframes), Config().relocalise, Config().tiles)
for module, name, signature in sorted(variants() - warm):
    print(f"{module}.{name}{signature}")
"""


def test_warm_up_leaves_no_kernel_variant_out(world: World, tmp_path: Path) -> None:
    """Counts variants in memory, so that a full cache on disk hides nothing."""
    shutil.copytree(world.query, tmp_path / "distorted")
    camera = tmp_path / "distorted" / "camera.toml"
    lens = re.sub(r"(?m)^distortion.*$", "", camera.read_text())
    camera.write_text(f'{lens}\ndistortion_model = "radtan"\ndistortion = [-0.01, 0.0, 0.0, 0.0]\n')
    # Whoever else runs on this machine may hold the usual port.
    program = PROGRAM.replace("ENDPOINT", f"ipc://{tmp_path}/poses")
    result = subprocess.run(
        [sys.executable, "-c", program, *map(str, (world.query, world.map, camera.parent))],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout == ""
