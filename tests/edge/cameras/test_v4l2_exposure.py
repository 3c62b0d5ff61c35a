# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from edge.cameras import v4l2_abi as abi
from edge.config.loader import load_struct
from edge.config.v4l2 import V4l2Config
from edge.errors import CameraRefused, ConfigError
from tests.edge.cameras.device_tree import MadeTree
from tests.edge.cameras.scripted_kernel import (
    PERIOD_NS,
    START_NS,
    Control,
    ScriptedKernel,
    pictures,
)
from tests.edge.cameras.v4l2_opened import EXPOSURE, open_camera, plugged, take


@pytest.fixture
def made(tmp_path: Path) -> MadeTree:
    return plugged(tmp_path)


def test_stamps_by_another_clock_are_refused(made: MadeTree) -> None:
    other = abi.BUF_FLAG_TSTAMP_SRC_SOE  # of an unknown clock
    camera = open_camera(ScriptedKernel(pictures(1, flags=other)), made)
    with pytest.raises(CameraRefused, match="does not stamp by the monotonic clock"):
        take(camera, 1)


def test_stamps_that_are_monotonic_by_name_only_are_refused(made: MadeTree) -> None:
    camera = open_camera(ScriptedKernel(pictures(1, stamp_offset_ns=10**18)), made)
    with pytest.raises(CameraRefused, match=r"stamps are \+1000000000\.0 s off"):
        take(camera, 1)


@pytest.mark.parametrize(
    ("source", "shutter", "shift_us"),
    [
        (abi.BUF_FLAG_TSTAMP_SRC_SOE, "global", 5000),
        (abi.BUF_FLAG_TSTAMP_SRC_SOE, "rolling", 5000 + 4000),
        (abi.BUF_FLAG_TSTAMP_SRC_EOF, "global", -5000 - 8000),
        (abi.BUF_FLAG_TSTAMP_SRC_EOF, "rolling", -5000 - 4000),
    ],
)
def test_frames_are_stamped_at_mid_exposure(
    made: MadeTree, source: int, shutter: str, shift_us: int
) -> None:
    flags = abi.BUF_FLAG_TIMESTAMP_MONOTONIC | source
    kernel = ScriptedKernel(pictures(1, flags=flags), controls=dict(EXPOSURE))
    settings = {"exposure_us": 10_000, "readout_us": 8_000, "stamp_delay_us": 1_500}
    frame = take(open_camera(kernel, made, shutter=shutter, **settings), 1)[0]
    stamp_ns = (START_NS + PERIOD_NS) // 1000 * 1000
    assert frame.t_ns - stamp_ns == (shift_us - 1500) * 1000
    assert frame.exposure_ns == 10_000_000


def test_the_rate_is_what_the_camera_agreed_to(
    made: MadeTree, caplog: pytest.LogCaptureFixture
) -> None:
    assert open_camera(ScriptedKernel([]), made, rate_hz=60).rate_hz == 60.0
    assert not caplog.records
    assert open_camera(ScriptedKernel([], fixed_rate=(1, 25)), made).rate_hz == 25.0
    assert "event=camera_rate" in caplog.text


def test_an_exposure_longer_than_a_frame_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text("exposure_us = 40000.0")
    with pytest.raises(ConfigError, match="longer than a frame at 30 Hz: set 33333 or less"):
        load_struct(path, V4l2Config)


def test_an_automatic_exposure_is_followed(made: MadeTree) -> None:
    exposure = Control(1, 5000, 100, flags=abi.CTRL_FLAG_VOLATILE)
    controls = {
        abi.CID_EXPOSURE_AUTO: Control(0, 3, 3, allowed=(1, 3)),
        abi.CID_EXPOSURE_ABSOLUTE: exposure,
        abi.CID_GAIN: Control(0, 100, 10, flags=abi.CTRL_FLAG_VOLATILE),
    }
    kernel = ScriptedKernel(pictures(25), controls=controls)
    camera = open_camera(kernel, made, gain_db_per_step=0.5)
    frames = take(camera, 5)
    exposure.value = 200
    frames += take(camera, 20)
    assert {frame.exposure_ns for frame in frames[:10]} == {10_000_000}
    assert {frame.exposure_ns for frame in frames[10:]} == {20_000_000}
    assert {frame.gain_db for frame in frames} == {5.0}
    # Stamps are of the exposure's start: its middle moves with it.
    assert frames[10].t_ns - frames[9].t_ns == pytest.approx(PERIOD_NS + 5_000_000, abs=2000)


def test_what_a_driver_only_remembers_is_not_taken_for_the_exposure(made: MadeTree) -> None:
    kernel = ScriptedKernel(pictures(3), controls=dict(EXPOSURE))
    assert take(open_camera(kernel, made), 1)[0].exposure_ns is None


def test_a_fixed_gain_is_told_in_decibels(made: MadeTree) -> None:
    kernel = ScriptedKernel(pictures(3), controls={abi.CID_GAIN: Control(0, 100, 0)})
    camera = open_camera(kernel, made, gain=20, gain_db_per_step=0.3)
    assert take(camera, 1)[0].gain_db == pytest.approx(6.0)
