# SPDX-License-Identifier: Apache-2.0
import threading
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from edge.config.camera import CameraConfig
from edge.runtime.doctor_host import Finding, Grade
from edge.runtime.doctor_look import look, look_through
from edge.types import Frame

PERIOD_NS = 33_333_333
AGE_NS = 20_000_000


def _image(kind: str) -> np.ndarray:
    noise = np.random.default_rng(0).integers(40, 200, (48, 64), dtype=np.uint8)
    images = {
        "good": noise,
        "dark": noise // 16,
        "white": np.where(noise > 100, np.uint8(255), noise),
        "blurred": np.add.outer(np.arange(48), np.arange(64)).astype(np.uint8) + np.uint8(60),
    }
    return images[kind]


class Scripted:
    """Frames 33 ms apart by their stamps, then silence until it is stopped."""

    def __init__(self, count: int, kind: str = "good", dropped: int = 0) -> None:
        self.dropped = dropped
        self.closed = False
        self.now_ns = 0
        self._count, self._image = count, _image(kind)
        self._stopped = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        for index in range(self._count):
            self.now_ns = index * PERIOD_NS + AGE_NS
            yield Frame(index, index * PERIOD_NS, self._image)
        self._stopped.wait(10.0)

    def stop(self) -> None:
        self._stopped.set()

    def close(self) -> None:
        self.closed = True


def _look(source: Scripted, rate_hz: float = 30.0, late_ns: int = 0) -> dict[str, Finding]:
    found = look_through(source, rate_hz, 0.2, lambda: source.now_ns + late_ns)
    assert source.closed
    return {finding.subject: finding for finding in found}


def test_a_good_camera_is_good_in_everything() -> None:
    found = _look(Scripted(40))
    assert set(found) == {"rate", "age", "light", "sharpness"}
    assert all(finding.grade is Grade.GOOD for finding in found.values())
    assert found["age"].found == "images are 20 ms old when they come"


@pytest.mark.parametrize(
    ("kind", "subject"), [("dark", "light"), ("white", "light"), ("blurred", "sharpness")]
)
def test_pictures_that_are_of_no_use_are_noticed(kind: str, subject: str) -> None:
    finding = _look(Scripted(40, kind))[subject]
    assert finding.grade is Grade.DOUBTFUL
    assert finding.remedy


def test_a_rate_that_is_not_kept_and_losses_are_noticed() -> None:
    assert _look(Scripted(40), rate_hz=60.0)["rate"].grade is Grade.DOUBTFUL
    assert _look(Scripted(40, dropped=10))["rate"].grade is Grade.DOUBTFUL


def test_old_images_and_such_of_the_future_are_noticed() -> None:
    assert _look(Scripted(40), late_ns=10**9)["age"].grade is Grade.DOUBTFUL
    assert _look(Scripted(40), late_ns=-(10**9))["age"].grade is Grade.BAD


def test_a_camera_that_shows_nothing_is_bad() -> None:
    assert _look(Scripted(2))["look"].grade is Grade.BAD


def test_a_camera_that_is_not_there_is_a_finding() -> None:
    config = msgspec.convert({"source": "v4l2", "v4l2": {"serial": "none"}}, CameraConfig)
    (finding,) = look(config, 0.1)
    assert (finding.grade, finding.subject) == (Grade.BAD, "look")
    assert look(CameraConfig()) == []  # there is none
