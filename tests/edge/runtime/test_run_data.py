# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.errors import OutputError, RecordingError
from edge.runtime.run_data import errors_against, read_run, read_truth
from tests.edge.runtime import scripted_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    scripted_run.write_run(folder / "run", 60, blind=range(40, 44))
    scripted_run.write_truth(folder / "truth.txt", 60)
    return folder / "run"


def test_run_reads_back_as_it_was_written(run: Path) -> None:
    data = read_run(run)
    assert len(data.t_ns) == len(data.states) == len(data.sigma_m) == 60
    assert data.states[40:44] == ["lost"] * 4
    assert np.isfinite(data.sigma_m).sum() == len(data.poses.t_ns) > 30
    assert len(data.odometry) == 2
    assert data.stats["frames"] == 60
    assert data.stats["tracked"] == 56
    assert data.stats["published"] == len(data.poses.t_ns)
    assert data.stats["fixes_tried"] == len(data.fixes)


def test_error_is_the_distance_to_the_truth(run: Path) -> None:
    errors = errors_against(read_truth(run.parent / "truth.txt"), read_run(run).poses)
    assert len(errors.t_ns) == len(read_run(run).poses.t_ns)
    assert np.allclose(errors.position_m, scripted_run.SHIFT_M, atol=1e-5)
    assert errors.rotation_deg.max() < 1e-3


def test_pose_without_truth_has_no_error(run: Path) -> None:
    lines = (run.parent / "truth.txt").read_text().splitlines(keepends=True)
    (run.parent / "half.txt").write_text("".join(lines[:30]))
    errors = errors_against(read_truth(run.parent / "half.txt"), read_run(run).poses)
    assert 0 < len(errors.t_ns) < 30


def test_other_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is no run folder"):
        read_run(tmp_path)


def test_damaged_run_is_refused_in_one_line(run: Path, tmp_path: Path) -> None:
    for file in run.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "frames.csv").write_text("index,t_ns,state,sigma_m\n0,x,lost,\n")
    with pytest.raises(OutputError, match="is a damaged run") as caught:
        read_run(tmp_path)
    assert "\n" not in str(caught.value)


def test_missing_truth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is missing"):
        read_truth(tmp_path / "none.txt")
