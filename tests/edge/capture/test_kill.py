# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.capture.reader import CaptureFile, StoredImage
from edge.capture.seal import is_sealed, seal
from tests.edge.capture.captures import PERIOD_NS, picture

PATIENCE_S = 60.0


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


@pytest.mark.slow
@pytest.mark.parametrize("size", [0, 100_000, 1_000_000])
def test_a_recording_that_was_killed_loses_its_last_second_at_most(
    tmp_path: Path, size: int
) -> None:
    path = tmp_path / "a.mcap"
    command = [sys.executable, "-m", "tests.edge.capture.endless_writer", str(path)]
    with subprocess.Popen(command) as process:
        ends = time.monotonic() + PATIENCE_S
        while _size(path) <= size and time.monotonic() < ends:
            time.sleep(0.001)
        process.kill()
    assert not is_sealed(path)
    on_disk = path.stat().st_size
    sealed = seal(path)
    assert sealed.bad_chunks == 0
    # A second of these images and what belongs to it; all before is there.
    assert sealed.cut_bytes < 60_000
    if on_disk > 100_000:
        places = CaptureFile(path).image_places
        assert [place.t_ns for place in places] == [n * PERIOD_NS for n in range(len(places))]
        last = places[-1]
        data = StoredImage(path, last.chunk, last.offset, 0).read_bytes()
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        np.testing.assert_array_equal(image, picture((len(places) - 1) % 20))
