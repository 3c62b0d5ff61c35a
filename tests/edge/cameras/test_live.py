# SPDX-License-Identifier: Apache-2.0
import itertools
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.cameras.live import open_live, open_uncalibrated
from edge.config.camera import CameraConfig
from edge.errors import CameraLost, CameraRefused, ConfigError
from edge.geometry.camera import CameraModel
from edge.geometry.camera_text import camera_toml
from tests.edge.cameras.device_tree import MadeTree
from tests.edge.cameras.scripted_kernel import ScriptedKernel, Unplugged, grey, pictures

MODEL = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)


def _config(tmp_path: Path, identity: str = "", **v4l2: object) -> CameraConfig:
    path = tmp_path / "camera.toml"
    path.write_text(camera_toml(MODEL, 30.0, identity))
    chosen = {"width": 64, "height": 48, "serial": "A1"} | v4l2
    return msgspec.convert(
        {"source": "v4l2", "calibration": str(path), "v4l2": chosen}, CameraConfig
    )


class ReturningKernel(ScriptedKernel):
    """Its device is back as soon as one looks for it."""

    def open(self, path: str) -> int:
        self.plug()
        return super().open(path)


@pytest.fixture
def made(tmp_path: Path) -> MadeTree:
    made = MadeTree(tmp_path / "tree")
    made.plug("1.2", 0, "A1")
    return made


def test_a_camera_that_comes_back_twice_goes_on(tmp_path: Path, made: MadeTree) -> None:
    script = [*pictures(3), Unplugged(), *pictures(2), Unplugged(), *pictures(2)]
    kernel = ReturningKernel(script)
    source = open_live(_config(tmp_path), kernel, made.tree)
    frames = []
    for frame in source:
        frames.append(frame)
        if len(frames) == 7:
            source.stop()
    source.close()
    assert [frame.index for frame in frames] == list(range(7))
    assert source.losses == 2
    np.testing.assert_array_equal(frames[-1].image, grey(1))
    assert not kernel.fds


def test_the_calibration_of_another_camera_is_refused(tmp_path: Path, made: MadeTree) -> None:
    config = _config(tmp_path, identity="path:elsewhere serial:B2")
    source = open_live(config, ScriptedKernel(pictures(3)), made.tree)
    with pytest.raises(CameraRefused, match="is the calibration of path:elsewhere serial:B2"):
        next(iter(source))
    source.close()


def test_its_own_is_taken(tmp_path: Path, made: MadeTree) -> None:
    identity = f"path:{made.socket('1.2').name} serial:A1"
    source = open_live(_config(tmp_path, identity), ScriptedKernel(pictures(3)), made.tree)
    assert len(list(itertools.islice(source, 2))) == 2
    source.stop()
    source.close()


def test_a_camera_without_a_calibration_is_opened_to_get_one(made: MadeTree) -> None:
    v4l2 = {"width": 64, "height": 48, "serial": "A1"}
    config = msgspec.convert({"source": "v4l2", "v4l2": v4l2}, CameraConfig)
    source = open_uncalibrated(config, ScriptedKernel(pictures(3)), made.tree)
    assert source.identity == f"path:{made.socket('1.2').name} serial:A1"
    (frame,) = itertools.islice(source, 1)
    np.testing.assert_array_equal(frame.image, grey(0))
    source.stop()
    source.close()
    made.plug("1.3", 2, "A1")  # which of the two it is nobody can say now
    with pytest.raises(CameraLost, match="2 cameras have serial A1"):
        open_uncalibrated(config, ScriptedKernel(pictures(3)), made.tree)


def test_a_calibration_that_names_no_camera_is_taken_for_what_is_there(
    tmp_path: Path, made: MadeTree
) -> None:
    source = open_live(_config(tmp_path), ScriptedKernel(pictures(3)), made.tree)
    assert source.identity.endswith("serial:A1")
    source.close()


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"source": "v4l2"}, r"camera\.calibration: is empty"),
        ({"source": "recording"}, "no live camera"),
    ],
)
def test_settings_that_name_no_camera_are_refused(settings: dict[str, str], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        open_live(msgspec.convert(settings, CameraConfig))


def test_a_camera_without_a_name_is_not_guessed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"camera\.v4l2\.device: is empty"):
        open_live(_config(tmp_path, serial=""))
    with pytest.raises(ConfigError, match=r"camera\.v4l2\.device: is empty"):
        open_uncalibrated(msgspec.convert({"source": "v4l2"}, CameraConfig))
