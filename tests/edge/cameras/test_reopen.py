# SPDX-License-Identifier: Apache-2.0
import itertools
import logging
from pathlib import Path

import pytest

from edge.cameras.reopen import ReopeningCamera
from edge.cameras.v4l2 import V4l2Camera
from edge.config.v4l2 import V4l2Config
from edge.errors import CameraRefused
from edge.geometry.camera import CameraModel
from tests.edge.cameras.device_tree import MadeTree
from tests.edge.cameras.scripted_kernel import (
    PERIOD_NS,
    Picture,
    ScriptedKernel,
    Unplugged,
    grey,
    pictures,
)

MODEL = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)
CONFIG = V4l2Config(serial="A1", width=64, height=48, stall_s=1.0)


class _Desk:
    """A camera, its clock, and somebody who plugs it in again some time after it was lost."""

    def __init__(self, root: Path, script: list, *, away_s: float = 0.0) -> None:
        self.made = MadeTree(root)
        self.made.plug("1.2", 0, "A1")
        self.kernel = ScriptedKernel(script)
        self.opened: list[int] = []
        self.closed = 0
        self._away_s = away_s
        self._plug_at_ns: int | None = None
        self.camera = ReopeningCamera(
            MODEL, 30.0, self._open, sleep=self.sleep, now_ns=self.kernel.monotonic_ns
        )

    def _open(self) -> V4l2Camera:
        self.opened.append(self.kernel.now_ns)
        return V4l2Camera(CONFIG, MODEL, self.kernel, self.made.tree)

    def sleep(self, seconds: float) -> None:
        self.kernel.now_ns += round(seconds * 1e9)
        if self._plug_at_ns is None:
            self._plug_at_ns = self.kernel.now_ns + round(self._away_s * 1e9)
        if self.kernel.now_ns >= self._plug_at_ns:
            self.kernel.plug()
            self._plug_at_ns = None


@pytest.mark.parametrize("away_s", [0.0, 0.7, 20.0])
def test_an_unplugged_camera_comes_back_twice_and_counts_on(
    tmp_path: Path, away_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "edge.cameras.reopen")
    script = [*pictures(4), Unplugged(), *pictures(4), Unplugged(), *pictures(4)]
    desk = _Desk(tmp_path, script, away_s=away_s)
    frames = list(itertools.islice(desk.camera, 12))
    assert [frame.index for frame in frames] == list(range(12))
    times = [frame.t_ns for frame in frames]
    assert times == sorted(times)
    for place in (4, 8):  # promised: back within 3 s of its return
        assert times[place] - times[place - 1] < (away_s + 3.0) * 1e9
    assert desk.camera.losses == 2
    assert caplog.text.count("event=camera_lost") == 2 * (1 if away_s == 0.0 else 2)
    assert caplog.text.count("event=camera_back") == 2
    assert not desk.kernel.fds


def test_retries_grow_rare_but_not_rarer_than_a_second(tmp_path: Path) -> None:
    desk = _Desk(tmp_path, [*pictures(1), Unplugged(), *pictures(1)], away_s=20.0)
    list(itertools.islice(desk.camera, 2))
    waits = [(b - a) * 1e-9 for a, b in itertools.pairwise(desk.opened)]
    assert max(waits) == pytest.approx(1.0, abs=0.01)
    assert 20 < len(desk.opened) < 30


def test_a_stall_is_ended_by_opening_anew(tmp_path: Path) -> None:
    script = [*pictures(2), Picture(grey(2).tobytes(), late_s=5.0), *pictures(2)]
    desk = _Desk(tmp_path, script)
    frames = list(itertools.islice(desk.camera, 5))
    assert [frame.index for frame in frames] == list(range(5))
    assert desk.camera.losses >= 1
    assert frames[2].t_ns - frames[1].t_ns < 5.0e9 + 3e9


def test_the_same_camera_is_found_under_another_number(tmp_path: Path) -> None:
    desk = _Desk(tmp_path, [*pictures(1), Unplugged(), *pictures(1)])
    frames = iter(desk.camera)
    next(frames)
    for link in (desk.made.dev / "v4l" / "by-path").iterdir():
        link.unlink()
    desk.made.plug("1.4", 6, "A1")
    assert next(frames).index == 1


def test_a_wrong_size_after_a_replug_is_refused(tmp_path: Path) -> None:
    desk = _Desk(tmp_path, [*pictures(1), Unplugged(), *pictures(1)])
    frames = iter(desk.camera)
    next(frames)
    desk.kernel.sizes = {"GREY": (32, 24)}
    with pytest.raises(CameraRefused, match="32x24"):
        next(frames)
    assert not desk.kernel.fds


def test_lost_frames_of_all_openings_add_up(tmp_path: Path) -> None:
    gap = Picture(grey(0).tobytes(), skipped=3)
    desk = _Desk(tmp_path, [*pictures(1), gap, Unplugged(), *pictures(1), gap])
    frames = list(itertools.islice(desk.camera, 4))
    assert [frame.index for frame in frames] == [0, 4, 5, 9]
    assert desk.camera.dropped == 6


def test_stop_ends_it_while_it_plays_and_while_it_waits(tmp_path: Path) -> None:
    desk = _Desk(tmp_path, pictures(5))
    frames = iter(desk.camera)
    next(frames)
    desk.camera.stop()
    assert list(frames) == []
    assert not desk.kernel.fds

    waiting = _Desk(tmp_path / "second", [])
    waiting.kernel.open_error = 2
    calls = itertools.count()
    waiting.camera._sleep = lambda seconds: waiting.camera.stop() if next(calls) == 5 else None
    assert list(waiting.camera) == []


def test_who_stops_reading_frees_the_device(tmp_path: Path) -> None:
    desk = _Desk(tmp_path, pictures(5))
    frames = iter(desk.camera)
    next(frames)
    frames.close()  # type: ignore[attr-defined]  # it is a generator
    assert not desk.kernel.fds
    assert desk.kernel.now_ns - desk.opened[0] == PERIOD_NS
