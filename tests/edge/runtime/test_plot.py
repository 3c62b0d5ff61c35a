# SPDX-License-Identifier: Apache-2.0
import resource
from pathlib import Path

import cv2
import pytest

from edge.errors import OutputError
from edge.runtime.plot import plot_run
from tests.edge.runtime import scripted_run

pytest.importorskip("matplotlib")


@pytest.mark.slow
@pytest.mark.parametrize("with_map", [True, False])
@pytest.mark.parametrize("with_truth", [True, False])
@pytest.mark.parametrize("frames", [0, 1, 60])
def test_every_kind_of_run_is_drawn(
    tmp_path: Path, frames: int, *, with_map: bool, with_truth: bool
) -> None:
    scripted_run.write_run(tmp_path / "run", frames, with_map=with_map, blind=range(30, 33))
    scripted_run.write_truth(tmp_path / "truth.txt", 60)
    truth = tmp_path / "truth.txt" if with_truth else None
    plot_run(tmp_path / "run", tmp_path / "plot.png", map_folder=None, truth=truth)
    picture = cv2.imread(str(tmp_path / "plot.png"))
    assert picture is not None
    assert picture.shape[0] > 500
    assert picture.std() > 5.0  # something is on it


def test_place_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    scripted_run.write_run(tmp_path / "run", 3)
    with pytest.raises(OutputError, match="cannot be written") as caught:
        plot_run(tmp_path / "run", tmp_path / "none" / "plot.png", map_folder=None, truth=None)
    assert "\n" not in str(caught.value)


def test_a_picture_stays_whole_where_the_disk_is_full(tmp_path: Path) -> None:
    scripted_run.write_run(tmp_path / "run", 3)
    out = tmp_path / "plot.png"
    out.write_bytes(b"an earlier picture")
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, usual[1]))
    try:
        with pytest.raises(OutputError, match="cannot be written"):
            plot_run(tmp_path / "run", out, map_folder=None, truth=None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    assert out.read_bytes() == b"an earlier picture"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plot.png", "run"]
