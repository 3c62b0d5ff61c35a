# SPDX-License-Identifier: Apache-2.0
"""A run folder written from scripted stages."""

import time
from pathlib import Path

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.config.runtime import RuntimeConfig
from edge.outputs import rows
from edge.outputs.run_folder import RunFolder
from edge.registration.registration import Registration
from edge.runtime.keyframe_worker import KeyframeTimes
from edge.runtime.pipeline import Pipeline
from edge.runtime.search import DelayedSearch, NoSearch, Search
from edge.runtime.tally import Tally
from tests.edge.runtime import scripted

SHIFT_M = 0.02  # what `write_truth` is off by
FIRST_T_NS = 0


def write_run(path: Path, frames: int, *, with_map: bool = True, blind: range = range(0)) -> None:
    """Run the scripted stages over `frames` frames."""
    search: Search = NoSearch()
    if with_map:
        search = DelayedSearch(scripted.TrueRelocaliser(), 3, time.thread_time_ns)
    pipeline = Pipeline(
        scripted.TrueOdometry(blind),
        Registration(RegistrationConfig()),
        search,
        RuntimeConfig(),
        time.thread_time_ns,
        KeyframeTimes(time.thread_time_ns, inline=True),
    )
    tally = Tally()
    with RunFolder(path, scripted.CAMERA) as folder:
        for frame in scripted.FrameList(frames):
            report = pipeline.step(frame)
            folder.write(report)
            tally.add(report, 0.0)
        tally.end()
        folder.finish(pipeline.trajectory(), tally.stats(0))


def write_truth(path: Path, frames: int) -> None:
    """The true poses, shifted by SHIFT_M."""
    lines = []
    for index in range(frames):
        T = np.array(scripted.true_pose(index))
        T[0, 3] += SHIFT_M
        lines.append(rows.tum(index * scripted.PERIOD_NS, T))
    path.write_text("".join(lines))
