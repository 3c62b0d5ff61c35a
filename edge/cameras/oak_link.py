# SPDX-License-Identifier: Apache-2.0
"""What passes between the process that talks to an OAK device and ours.

Images go through shared memory without a name, so that nothing is left of it whoever dies;
messages through a pipe.
"""

import mmap
import os
import struct
from typing import NamedTuple, TypeAlias

import msgspec
import numpy as np

from edge.config.oak import OakConfig
from edge.types import U8

_SLOTS = 8  # a quarter of a second at 30 Hz, for a late reader
_PAGE = 4096
_LENGTH = struct.Struct("<I")
_MAX_MESSAGE_BYTES = 65536


class Replay(msgspec.Struct, frozen=True):
    """depthai's own player in the device's place."""

    video: str
    metadata: str = ""


class Order(msgspec.Struct, frozen=True):
    """What the child is to do."""

    config: OakConfig
    memory_fd: int
    messages_fd: int
    replay: Replay | None = None
    colour: bool = False  # NV12 instead of grey


def rows_of(order: Order) -> int:
    """Rows of bytes of an image: in NV12 the colours lie below the grey."""
    height = order.config.height
    return height + height // 2 if order.colour else height


class Opened(msgspec.Struct, frozen=True, tag=True):
    """The device is there."""

    device_id: str
    product: str
    usb_speed: str
    lens_model: str = ""  # empty: it says nothing about its lens
    K: list[list[float]] = []
    coefficients: list[float] = []
    is_default: bool = False  # of the model, not of this device


class Taken(msgspec.Struct, frozen=True, tag=True):
    """An image is in a slot."""

    slot: int
    mark: int
    sequence: int
    t_ns: int
    exposure_ns: int
    iso: int


class Refused(msgspec.Struct, frozen=True, tag=True):
    """A person has to act."""

    reason: str


class Gone(msgspec.Struct, frozen=True, tag=True):
    """The device is not there, or no longer."""

    reason: str


Message: TypeAlias = Opened | Taken | Refused | Gone
_DECODER = msgspec.msgpack.Decoder(Message)


class ImageSlots:
    """A few images of one size in memory that two processes share.

    Each slot has a mark beside it, which is 0 while it is written: a reader that is so late that
    the writer has come round again notices.
    """

    def __init__(self, fd: int, width: int, height: int) -> None:
        self._shape = (height, width)
        self._bytes = width * height
        size = _PAGE + _SLOTS * self._bytes
        if os.fstat(fd).st_size < size:
            os.ftruncate(fd, size)
        self._memory = mmap.mmap(fd, size)
        self._marks = np.frombuffer(self._memory, np.uint64, _SLOTS)
        self._images = np.frombuffer(self._memory, np.uint8, _SLOTS * self._bytes, _PAGE)

    def write(self, mark: int, image: U8) -> int:
        """Put `image` (h, w) into the slot that is its turn; return the slot. `mark` is above 0."""
        slot = mark % _SLOTS
        self._marks[slot] = 0
        self._slot(slot)[:] = image
        self._marks[slot] = mark
        return slot

    def read(self, slot: int, mark: int) -> U8 | None:
        """Copy the image that was marked so; None where another one has taken its place."""
        if int(self._marks[slot]) != mark:
            return None
        image = self._slot(slot).copy()
        if int(self._marks[slot]) != mark:
            return None
        image.flags.writeable = False
        return image

    def close(self) -> None:
        """Free the memory."""
        del self._marks, self._images
        self._memory.close()

    def _slot(self, slot: int) -> U8:
        begin = slot * self._bytes
        plane: U8 = self._images[begin : begin + self._bytes].reshape(self._shape)
        return plane


def make_memory() -> int:
    """Descriptor of memory that can be shared with a child."""
    return os.memfd_create("mapvo-oak", os.MFD_CLOEXEC)


def send(fd: int, message: Message) -> None:
    """Write a message; BrokenPipeError where nobody reads any more."""
    data = msgspec.msgpack.encode(message)
    os.write(fd, _LENGTH.pack(len(data)) + data)  # below PIPE_BUF: all or nothing


class Received(NamedTuple):
    """What has come."""

    messages: list[Message]
    ended: bool


class Receiver:
    """Puts messages together from what a pipe gives."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._buffer = b""

    def receive(self) -> Received:
        """Whatever is there now; call it when the pipe is readable."""
        data = os.read(self._fd, _MAX_MESSAGE_BYTES)
        self._buffer += data
        messages: list[Message] = []
        while len(self._buffer) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._buffer)
            end = _LENGTH.size + length
            if len(self._buffer) < end:
                break
            try:
                messages.append(_DECODER.decode(self._buffer[_LENGTH.size : end]))
            except msgspec.DecodeError:
                messages.append(Gone("its process sends nonsense"))
            self._buffer = self._buffer[end:]
        return Received(messages, not data)
