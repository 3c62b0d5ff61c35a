# SPDX-License-Identifier: Apache-2.0
"""The process that talks to an OAK device: `python -m edge.cameras.oak_child ORDER`.

depthai is large, has threads of its own, and hangs or ends the process when a device misbehaves:
so it lives in a process that can be killed.
"""

import datetime
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec

from edge.cameras.oak_link import (
    Gone,
    ImageSlots,
    Message,
    Opened,
    Order,
    Refused,
    Taken,
    rows_of,
    send,
)
from edge.child_process import end_with_parent
from edge.config.oak import OakConfig

_POLL = datetime.timedelta(milliseconds=200)
_TOLERANCE = 0.05  # of an exposure that was asked for; sensors count it in rows
_SETTLED_FRAMES = 15  # a setting takes effect some frames later


def main() -> int:
    """Send images until nobody listens or the device is gone."""
    end_with_parent()
    order = msgspec.json.decode(sys.argv[1], type=Order)
    try:
        import depthai as dai
    except ImportError as error:
        reason = f"needs depthai ({error}): pip install 'mapvo[oak]'"
        return _end(order.messages_fd, Refused(reason))
    slots = ImageSlots(order.memory_fd, order.config.width, rows_of(order))
    try:
        source = _replay(dai, order) if order.replay is not None else _device(dai, order)
        with source as (opened, pipeline, queue):
            send(order.messages_fd, opened)
            return _end(order.messages_fd, _pump(dai, order, slots, pipeline, queue))
    except BrokenPipeError:
        return 0
    except Exception as error:  # noqa: BLE001  # those of depthai have no base in common
        return _end(order.messages_fd, _explain(str(error) or type(error).__name__))


def _end(fd: int, message: Message) -> int:
    try:
        send(fd, message)
    except BrokenPipeError:
        return 0
    return 1


def _pump(dai: Any, order: Order, slots: ImageSlots, pipeline: Any, queue: Any) -> Message:
    """Pass on images until there are no more; returns why."""
    mark = 0
    shape = (rows_of(order), order.config.width)
    while pipeline.isRunning():
        try:
            image_message = queue.get(_POLL)
        except dai.MessageQueue.QueueException:  # its pipeline has ended
            break
        if image_message is None:
            _check_listener(order.messages_fd)
            continue
        image = image_message.getFrame()
        if image.shape != shape:
            size = f"{image.shape[1]}x{image.shape[0]}"
            return Refused(f"gives {size}, not {shape[1]}x{shape[0]}: set a size that it has")
        mark += 1
        taken = _taken(dai, image_message, slots.write(mark, image), mark)
        is_settled = order.replay is None and mark == _SETTLED_FRAMES
        if is_settled and (problem := _exposure_problem(order.config, taken)):
            return Refused(problem)
        send(order.messages_fd, taken)
    return Gone("was unplugged or has stopped")


def _taken(dai: Any, message: Any, slot: int, mark: int) -> Taken:
    # By the host's clock, which depthai keeps in step with the device's; CLOCK_MONOTONIC.
    middle = message.getTimestamp(dai.CameraExposureOffset.MIDDLE)
    microsecond = datetime.timedelta(microseconds=1)
    return Taken(
        slot=slot,
        mark=mark,
        sequence=message.getSequenceNum(),
        t_ns=middle // microsecond * 1000,
        exposure_ns=message.getExposureTime() // microsecond * 1000,
        iso=message.getSensitivity(),
    )


def _exposure_problem(config: OakConfig, taken: Taken) -> str | None:
    """What is wrong where the sensor does not expose as it was told to."""
    got_us = taken.exposure_ns / 1000
    if config.exposure_us is not None:
        if abs(got_us / config.exposure_us - 1.0) > _TOLERANCE:
            return f"made exposure_us {got_us:.0f} of {config.exposure_us}: set one that it keeps"
    elif got_us > config.exposure_limit_us * (1.0 + _TOLERANCE):
        limit = config.exposure_limit_us
        return f"exposes for {got_us:.0f} us, above exposure_limit_us {limit}: set exposure_us"
    return None


def _check_listener(fd: int) -> None:
    """Notice that nobody listens any more, though there is nothing to say."""
    poller = select.poll()
    poller.register(fd, 0)
    if poller.poll(0):
        raise BrokenPipeError


@contextmanager
def _device(dai: Any, order: Order) -> Iterator[tuple[Opened, Any, Any]]:
    """A device's stream."""
    config = order.config
    with _open_device(dai, config) as device, dai.Pipeline(device) as pipeline:
        device.setMaxReconnectionAttempts(0)  # ours is to look for it again, as a whole
        socket = getattr(dai.CameraBoardSocket, config.socket)
        if socket not in device.getConnectedCameras():
            names = ", ".join(sorted(found.name for found in device.getConnectedCameras()))
            raise RuntimeError(f"refused: has no sensor {config.socket}, but {names}")
        camera = pipeline.create(dai.node.Camera).build(socket)
        set_exposure(camera.initialControl, config)
        size = (config.width, config.height)
        kind = _frame_type(dai, order)
        output = camera.requestOutput(size, type=kind, fps=config.rate_hz)
        queue = output.createOutputQueue(maxSize=4, blocking=False)
        opened = _opened(dai, device, socket, config)
        pipeline.start()
        yield opened, pipeline, queue


def _frame_type(dai: Any, order: Order) -> Any:
    return dai.ImgFrame.Type.NV12 if order.colour else dai.ImgFrame.Type.GRAY8


def _open_device(dai: Any, config: OakConfig) -> Any:
    if not config.device_id:
        return dai.Device()
    is_there, info = dai.Device.getDeviceById(config.device_id)
    if not is_there:
        raise RuntimeError(f"no device {config.device_id}")
    return dai.Device(info)


def set_exposure(control: Any, config: OakConfig) -> None:
    """Fix the exposure, or bound the automatic one."""
    if config.exposure_us is not None:
        control.setManualExposure(config.exposure_us, config.iso)
    else:
        control.setAutoExposureEnable()
        control.setAutoExposureLimit(config.exposure_limit_us)


def _opened(dai: Any, device: Any, socket: Any, config: OakConfig) -> Opened:
    try:
        calibration, is_default = device.readCalibration2(), False
    except RuntimeError:  # none is stored in it
        calibration, is_default = device.readCalibration(), True
    model, K, coefficients = read_lens(calibration, socket, config.width, config.height)
    return Opened(
        device_id=device.getDeviceId(),
        product=device.getProductName() or device.getDeviceName(),
        usb_speed=device.getUsbSpeed().name,
        lens_model=model,
        K=K,
        coefficients=coefficients,
        is_default=is_default,
    )


def read_lens(
    calibration: Any, socket: Any, width: int, height: int
) -> tuple[str, list[list[float]], list[float]]:
    """Lens model, intrinsics for images of this size, and coefficients, as depthai has them."""
    return (
        calibration.getDistortionModel(socket).name,
        [list(row) for row in calibration.getCameraIntrinsics(socket, width, height)],
        list(calibration.getDistortionCoefficients(socket)),
    )


@contextmanager
def _replay(dai: Any, order: Order) -> Iterator[tuple[Opened, Any, Any]]:
    """The player of depthai on the host: the same queue and messages, without a device."""
    assert order.replay is not None
    with dai.Pipeline(createImplicitDevice=False) as pipeline:
        player = pipeline.create(dai.node.ReplayVideo)
        player.setReplayVideoFile(order.replay.video)
        if order.replay.metadata:
            player.setReplayMetadataFile(order.replay.metadata)
        player.setOutFrameType(_frame_type(dai, order))
        player.setLoop(False)
        queue = player.out.createOutputQueue(maxSize=4, blocking=True)
        pipeline.start()
        yield Opened("replay", "ReplayVideo", "UNKNOWN"), pipeline, queue


def _explain(text: str) -> Message:
    """What depthai's words mean for us."""
    if text.startswith("refused: "):
        return Refused(text.removeprefix("refused: "))
    if "INSUFFICIENT_PERMISSIONS" in text.upper():
        return Refused("may not be opened: install the udev rule for Luxonis devices (03e7)")
    return Gone(text.splitlines()[0])


if __name__ == "__main__":
    sys.exit(main())
