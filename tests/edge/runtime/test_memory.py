# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys
from pathlib import Path

import pytest

# In a process of its own: the allocator's settings cannot be taken back.
PROGRAM = """
import gc
import numpy as np
from edge.kernel import kernel
from edge.runtime.memory import keep_small, settle_down

def resident_kb():
    return next(int(l.split()[1]) for l in open("/proc/self/status") if l.startswith("VmRSS"))

@kernel
def double(values, out):
    for i in range(values.shape[0]):
        out[i] = 2 * values[i]

keep_small()
out = np.zeros(3)
double(np.arange(3.0), out)
rubbish = [np.ones(2000) for _ in range(3000)]  # 48 MB in the heap
full = resident_kb()
del rubbish
settle_down()
freed = full - resident_kb()
assert gc.get_freeze_count() > 1000
assert freed > 30_000, freed
# The compiler's code, given back as well, comes again when it is needed.
whole = np.zeros(3, np.int64)
double(np.arange(3), whole)
assert whole.tolist() == [0, 2, 4]
print("good")
"""


@pytest.mark.slow
def test_what_start_up_used_is_given_back_and_compiling_still_works(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    result = subprocess.run(
        [sys.executable, tmp_path / "program.py"],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.stdout, result.returncode) == ("good\n", 0), result.stderr
