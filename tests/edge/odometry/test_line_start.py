# SPDX-License-Identifier: Apache-2.0
"""When a start by edges is taken, of reconstructions that are scripted."""

import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.odometry import line_start
from edge.odometry.line_start import LineStarter
from edge.odometry.line_structure import Found, Minimum, Seen
from edge.odometry.structure import Structure
from edge.types import Frame
from tests.edge.odometry.test_line_trail import CAMERA, MASK, STEP_PX, wall

N_FRAMES = 50


def found(seen: Seen, *, certain: bool) -> Found:
    """A camera that goes to the right, its depths known to a hundredth, or not at all."""
    others = [k - seen.place for k in range(len(seen.line) + 1) if k != seen.place]
    poses = tuple(se3.exp(np.array([-0.1 * k, 0.0, 0.0, 0.0, 0.0, 0.0])) for k in others)
    n = len(seen.rays)
    sigma = np.full(n, 0.01 if certain else 1.0)
    structure = Structure(poses, np.ones(n), sigma, np.ones(n, np.uint8), 0.1)
    information = np.eye(6 * len(poses))
    return Found(
        structure,
        0.1,
        np.inf,
        information,
        Minimum(list(poses), np.ones(n), np.zeros((len(poses), n))),
    )


def first_start(
    monkeypatch: pytest.MonkeyPatch, scatter_deg: float, uncertain_every: int
) -> int | None:
    """Number of the try that is taken, of those where every so many are uncertain; None: none."""
    tries = 0

    def reconstruct(seen: Seen, _focal_px: float) -> Found:
        nonlocal tries
        tries += 1
        return found(seen, certain=tries % uncertain_every > 0)

    monkeypatch.setattr(line_start, "reconstruct", reconstruct)
    monkeypatch.setattr(line_start, "scatter_rad", lambda *_: np.deg2rad(scatter_deg))
    starter = LineStarter(CAMERA, MASK, OdometryConfig())
    for k in range(N_FRAMES):
        if starter.step(Frame(k, k, MASK), wall(k * STEP_PX)) is not None:
            return tries
    assert tries > N_FRAMES // 2
    return None


def test_a_steady_way_is_taken_once_several_tries_in_a_row_tell_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert first_start(monkeypatch, 1.0, 1000) == 5


def test_a_way_that_scatters_is_waited_with_but_not_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken = first_start(monkeypatch, 9.0, 1000)
    assert taken is not None
    assert taken > 8


def test_tries_before_an_uncertain_one_make_no_scatter_pass(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert first_start(monkeypatch, 9.0, 9) is None
