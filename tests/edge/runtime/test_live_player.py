# SPDX-License-Identifier: Apache-2.0
import threading
from collections.abc import Callable, Iterator
from contextlib import closing

import numpy as np
import pytest

from edge.errors import CameraLost, CameraRefused
from edge.runtime.live_player import LivePlayer
from edge.types import Frame
from tests.edge.runtime.scripted import CAMERA, PERIOD_NS

PATIENCE_S = 30.0


class Camera:
    """Gives what its script says; `None` waits until the test lets it go on."""

    camera = CAMERA
    rate_hz = 30.0
    dropped = 0
    losses = 0

    def __init__(self, *scripts: list[int | Exception | None]) -> None:
        self._scripts = iter(scripts)
        self._go = threading.Semaphore(0)
        self._stopped = False
        self.closed = False

    def __iter__(self) -> Iterator[Frame]:
        for item in next(self._scripts, []):
            if isinstance(item, Exception):
                raise item
            if item is None:
                self._go.acquire()
                if self._stopped:
                    return
            else:
                yield Frame(item, item * PERIOD_NS, np.zeros((48, 64), np.uint8))

    def go_on(self) -> None:
        self._go.release()

    def stop(self) -> None:
        self._stopped = True
        self._go.release(100)

    def close(self) -> None:
        self.closed = True


def nothing() -> None:
    """No settling."""


def taken(player: LivePlayer, count: int) -> list[int]:
    frames = [player.take(PATIENCE_S) for _ in range(count)]
    return [frame.index for frame in frames if frame is not None]


def wait_until(true: Callable[[], bool]) -> None:
    pause = threading.Event()
    for _ in range(int(PATIENCE_S / 0.01)):
        if true():
            return
        pause.wait(0.01)
    raise AssertionError("it never came")


def test_frames_come_in_order_and_the_end_is_told() -> None:
    camera = Camera([0, None, 1, None])
    with closing(LivePlayer(camera, nothing)) as player:
        assert taken(player, 1) == [0]
        camera.go_on()
        assert taken(player, 1) == [1]
        assert not player.ended
        camera.go_on()
        assert player.take(PATIENCE_S) is None
        assert player.ended
        assert player.state(0) == "ended"
    assert camera.closed


def test_slow_taker_gets_the_newest_and_the_rest_is_counted() -> None:
    camera = Camera([*range(10), None])
    with closing(LivePlayer(camera, nothing)) as player:
        wait_until(lambda: player.dropped == 8)
        assert taken(player, 2) == [8, 9]


def test_frames_left_out_on_purpose_are_not_dropped() -> None:
    camera = Camera([None, *range(6), None])
    with closing(LivePlayer(camera, nothing)) as player:
        player.keep_every = 3
        camera.go_on()
        assert taken(player, 2) == [0, 3]
        assert player.dropped == 0


def test_camera_that_is_refused_after_it_worked_is_tried_until_it_is_right() -> None:
    wrong = CameraRefused("gives 640x480, not 64x48")
    camera = Camera([0, wrong], [wrong], [None, 1, None])
    with closing(LivePlayer(camera, nothing)) as player:
        assert taken(player, 1) == [0]
        wait_until(lambda: player.state(0) == "refused")
        camera.go_on()
        assert taken(player, 1) == [1]
        assert player.state(0) == "ok"


def test_camera_that_is_refused_from_the_start_is_an_error() -> None:
    with closing(LivePlayer(Camera([CameraRefused("wrong size")]), nothing)) as player:
        wait_until(lambda: player.ended)
        with pytest.raises(CameraRefused, match="wrong size"):
            player.take(PATIENCE_S)


def test_source_that_is_lost_for_good_ends() -> None:
    with closing(LivePlayer(Camera([0, CameraLost("broken")]), nothing)) as player:
        assert taken(player, 1) == [0]
        assert player.take(PATIENCE_S) is None
        assert player.ended


def test_what_ended_the_source_is_never_taken_for_its_end() -> None:
    camera = Camera([0, None, RuntimeError("a bug")])
    with closing(LivePlayer(camera, nothing)) as player:
        assert taken(player, 1) == [0]
        camera.go_on()
        with pytest.raises(RuntimeError, match="a bug"):
            player.take(PATIENCE_S)


def test_silence_is_told_after_a_second() -> None:
    camera = Camera([0, None])
    with closing(LivePlayer(camera, nothing)) as player:
        assert player.state(0) in ("starting", "ok")
        taken(player, 1)
        assert player.state(0) == "ok"
        assert player.state(1 << 62) == "silent"


def test_stop_ends_a_waiting_source() -> None:
    player = LivePlayer(Camera([None, 0]), nothing)
    player.stop()
    assert player.take(PATIENCE_S) is None
    player.close()


def test_settling_happens_in_the_cameras_thread() -> None:
    names: list[str] = []
    with closing(LivePlayer(Camera([0]), lambda: names.append(threading.current_thread().name))):
        pass
    assert names == ["camera"]
