# SPDX-License-Identifier: Apache-2.0
import logging

import msgspec
import pytest

from edge.cameras import v4l2_abi as abi
from edge.cameras.v4l2_controls import set_exposure_and_gain
from edge.cameras.v4l2_stream import VideoStream
from edge.config.v4l2 import V4l2Config
from edge.errors import CameraRefused
from tests.edge.cameras.scripted_kernel import Control, ScriptedKernel


def _uvc() -> dict[int, Control]:
    """What most USB cameras have."""
    return {
        abi.CID_EXPOSURE_AUTO: Control(0, 3, 3, allowed=(1, 3)),
        abi.CID_EXPOSURE_ABSOLUTE: Control(3, 2047, 250),
        abi.CID_EXPOSURE_AUTO_PRIORITY: Control(0, 1, 1),
        abi.CID_GAIN: Control(0, 100, 20),
    }


def _set(controls: dict[int, Control], **settings: object) -> tuple[int | None, ScriptedKernel]:
    kernel = ScriptedKernel([], controls=controls)
    stream = VideoStream(kernel, "/dev/video0")
    exposure_ns = set_exposure_and_gain(stream, msgspec.convert(settings, V4l2Config))
    stream.close()
    return exposure_ns, kernel


def test_automatic_goes_off_before_the_value_is_set(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    exposure_ns, kernel = _set(_uvc(), exposure_us=8000)
    assert exposure_ns == 8_000_000
    assert kernel.log == [
        (abi.CID_EXPOSURE_AUTO_PRIORITY, 0),
        (abi.CID_EXPOSURE_AUTO, abi.EXPOSURE_MANUAL),
        (abi.CID_EXPOSURE_ABSOLUTE, 80),
    ]
    assert "exposure=80 wanted=80" in caplog.text


def test_the_exposure_that_counts_is_the_one_read_back() -> None:
    controls = _uvc()
    controls[abi.CID_EXPOSURE_ABSOLUTE].keeps = lambda value: value - value % 16
    controls[abi.CID_EXPOSURE_ABSOLUTE].step = 16
    assert _set(controls, exposure_us=8700)[0] == 8_000_000


def test_a_value_that_the_camera_does_not_keep_is_refused() -> None:
    controls = _uvc()
    controls[abi.CID_EXPOSURE_ABSOLUTE].keeps = lambda value: 250
    with pytest.raises(CameraRefused, match="made exposure 250 of 80"):
        _set(controls, exposure_us=8000)


def test_automatic_that_comes_on_again_is_refused() -> None:
    controls = _uvc()
    controls[abi.CID_EXPOSURE_AUTO].keeps = lambda value: 3
    with pytest.raises(CameraRefused, match="came on again"):
        _set(controls, exposure_us=8000)


def test_limits_are_said_in_the_configurations_unit() -> None:
    with pytest.raises(CameraRefused, match="exposure_us from 300 to 204700, not 200"):
        _set(_uvc(), exposure_us=200)


def test_a_camera_without_the_control_is_refused() -> None:
    controls = _uvc()
    del controls[abi.CID_EXPOSURE_ABSOLUTE]
    with pytest.raises(CameraRefused, match="leave exposure_us out"):
        _set(controls, exposure_us=8000)


def test_a_control_that_nobody_may_set_does_not_count() -> None:
    controls = _uvc()
    controls[abi.CID_EXPOSURE_ABSOLUTE].flags = abi.CTRL_FLAG_READ_ONLY
    with pytest.raises(CameraRefused, match="cannot be set in microseconds"):
        _set(controls, exposure_us=8000)


@pytest.mark.parametrize(("allowed", "mode"), [((1, 3), 3), ((0, 1), 0)])
def test_without_a_value_automatic_is_switched_on(allowed: tuple[int, ...], mode: int) -> None:
    controls = _uvc()
    controls[abi.CID_EXPOSURE_AUTO] = Control(0, 3, 1, allowed=allowed)  # left so by another
    exposure_ns, kernel = _set(controls)
    assert exposure_ns is None
    assert controls[abi.CID_EXPOSURE_AUTO].value == mode
    assert abi.CID_EXPOSURE_ABSOLUTE not in dict(kernel.log)


def test_gain_is_set_within_its_limits() -> None:
    controls = _uvc() | {abi.CID_AUTOGAIN: Control(0, 1, 1)}
    _set(controls, gain=37)
    assert controls[abi.CID_GAIN].value == 37
    assert controls[abi.CID_AUTOGAIN].value == 0
    with pytest.raises(CameraRefused, match="gain from 0 to 100, not 101"):
        _set(_uvc(), gain=101)


def test_a_sensor_has_its_gain_elsewhere() -> None:
    controls = {abi.CID_ANALOGUE_GAIN: Control(16, 248, 16)}
    _set(controls, gain=100)
    assert controls[abi.CID_ANALOGUE_GAIN].value == 100


def test_a_camera_without_any_control_works_as_it_is() -> None:
    assert _set({})[0] is None
    with pytest.raises(CameraRefused, match="leave gain out"):
        _set({}, gain=1)
