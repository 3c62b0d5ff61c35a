# SPDX-License-Identifier: Apache-2.0
"""What passes between the process of the user's model and ours.

The image lies in shared memory without a name; orders and answers go through two pipes. What comes
from the child is checked like a file from outside: a model may have spoiled its memory.
"""

import mmap
import os
import struct
from typing import NamedTuple, TypeAlias

import msgspec
import numpy as np

from edge.config.segmenter import SegmenterConfig
from edge.segmenter.contract import Contract
from edge.types import U8, Detections, Mask

MARK = struct.Struct("<Q")  # an order to segment what lies in the memory, and its number
_LENGTH = struct.Struct("<I")
_MAX_ANSWER_BYTES = 16_000_000  # 100 masks of a whole image of 1280x800, a bit a pixel


class Order(msgspec.Struct, frozen=True):
    """What the child is to do."""

    model: str
    config: SegmenterConfig
    shape: tuple[int, ...]  # of the images
    memory_fd: int
    answers_fd: int


class Ready(msgspec.Struct, frozen=True, tag=True):
    """The model is open and has passed its trial."""

    contract: Contract


class Refused(msgspec.Struct, frozen=True, tag=True):
    """The model cannot be used; a person has to act."""

    reason: str


class PackedMask(msgspec.Struct, frozen=True, array_like=True):
    """A mask, a bit a pixel, rows without gaps."""

    left: int
    top: int
    width: int
    height: int
    bits: bytes


class Seen(msgspec.Struct, frozen=True, tag=True):
    """What is in the image of that number."""

    mark: int
    ms: float  # of processor time
    boxes: bytes
    scores: bytes
    classes: bytes
    masks: list[PackedMask]
    rss_mb: float


class Failed(msgspec.Struct, frozen=True, tag=True):
    """Nothing came of the image of that number."""

    mark: int
    reason: str


Answer: TypeAlias = Ready | Refused | Seen | Failed
_DECODER = msgspec.msgpack.Decoder(Answer)


class ImageMemory:
    """Room for one image that two processes share."""

    def __init__(self, fd: int, shape: tuple[int, ...]) -> None:
        size = int(np.prod(shape))
        if os.fstat(fd).st_size < size:
            os.ftruncate(fd, size)
        self._memory = mmap.mmap(fd, size)
        self.image: U8 = np.frombuffer(self._memory, np.uint8, size).reshape(shape)

    def close(self) -> None:
        """Free the memory."""
        del self.image
        self._memory.close()


def make_memory() -> int:
    """Descriptor of memory that can be shared with a child."""
    return os.memfd_create("mapvo-segmenter", os.MFD_CLOEXEC)


def pack(mark: int, detections: Detections, ms: float, rss_mb: float) -> Seen:
    """An answer that carries detections."""
    masks = [
        PackedMask(
            m.left, m.top, m.inside.shape[1], m.inside.shape[0], np.packbits(m.inside).tobytes()
        )
        for m in detections.masks
    ]
    arrays = (detections.boxes, detections.scores, detections.classes)
    boxes, scores, classes = (np.ascontiguousarray(array).tobytes() for array in arrays)
    return Seen(mark, ms, boxes, scores, classes, masks, rss_mb)


def unpack(seen: Seen, shape: tuple[int, ...]) -> Detections:
    """The detections of an answer about an image of `shape`; ValueError where they are spoiled."""
    boxes = np.frombuffer(seen.boxes, np.float32).reshape(-1, 4)
    scores = np.frombuffer(seen.scores, np.float32)
    classes = np.frombuffer(seen.classes, np.int32)
    if not len(boxes) == len(scores) == len(classes) == len(seen.masks):
        raise ValueError("its parts differ in number")
    if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
        raise ValueError("it holds what is no number")
    masks = tuple(_unpack_mask(mask, shape) for mask in seen.masks)
    return Detections(boxes, scores, classes, masks)


def _unpack_mask(mask: PackedMask, shape: tuple[int, ...]) -> Mask:
    height, width = shape[:2]
    fits = 0 <= mask.left < mask.left + mask.width <= width
    fits = fits and 0 <= mask.top < mask.top + mask.height <= height
    n = mask.width * mask.height
    if not fits or len(mask.bits) != (n + 7) // 8:
        raise ValueError("a mask does not fit the image")
    bits = np.unpackbits(np.frombuffer(mask.bits, np.uint8), count=n).view(np.bool_)
    bits.flags.writeable = False
    return Mask(mask.left, mask.top, bits.reshape(mask.height, mask.width))


def send(fd: int, answer: Answer) -> None:
    """Write an answer; BrokenPipeError where nobody reads any more."""
    data = msgspec.msgpack.encode(answer)
    view = memoryview(_LENGTH.pack(len(data)) + data)
    while view:
        view = view[os.write(fd, view) :]


class Received(NamedTuple):
    """What has come."""

    answers: list[Answer]
    ended: bool


class Receiver:
    """Puts answers together from what a pipe gives."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._buffer = bytearray()

    def receive(self) -> Received:
        """Whatever is there now; call it when the pipe is readable. ValueError for nonsense."""
        data = os.read(self._fd, 1 << 20)
        self._buffer += data
        answers: list[Answer] = []
        while len(self._buffer) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._buffer)
            if length > _MAX_ANSWER_BYTES:
                raise ValueError("its process sends nonsense")
            end = _LENGTH.size + length
            if len(self._buffer) < end:
                break
            body = bytes(self._buffer[_LENGTH.size : end])
            del self._buffer[:end]
            try:
                answers.append(_DECODER.decode(body))
            except msgspec.DecodeError:
                raise ValueError("its process sends nonsense") from None
        return Received(answers, not data)
