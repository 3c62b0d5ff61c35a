# SPDX-License-Identifier: Apache-2.0
"""The process that runs the user's model: `python -m edge.segmenter.child ORDER`.

A model may hang, eat memory or end the process: so it lives in one that can be killed, that gives
way to everything, and that the system takes first when memory is short.
"""

import os
import resource
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from edge.child_process import end_with_parent, give_way
from edge.errors import EdgeError, ModelRefused
from edge.segmenter.link import MARK, Failed, ImageMemory, Order, Ready, Refused, pack, send

if TYPE_CHECKING:
    from edge.segmenter.model import Model


def main() -> int:
    """Answer orders until nobody sends any."""
    end_with_parent()
    order = msgspec.json.decode(sys.argv[1], type=Order)
    give_way(order.config.nice)
    _bound_memory(order.config.memory_mb)
    try:
        model = _open(order)
        if model is None:
            return 1
        memory = ImageMemory(order.memory_fd, order.shape)
        send(order.answers_fd, Ready(model.contract))
        while len(data := sys.stdin.buffer.read(MARK.size)) == MARK.size:
            _answer(order, model, memory, MARK.unpack(data)[0])
    except BrokenPipeError:
        pass
    return 0


def _bound_memory(memory_mb: int) -> None:
    limit = memory_mb << 20
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _use_cores(cpus: Sequence[int]) -> None:
    if not cpus:
        return
    try:
        os.sched_setaffinity(0, cpus)
    except OSError as error:
        why = error.strerror or error
        raise ModelRefused(f"segmenter.cpus = {list(cpus)}: {why}: name cores that exist") from None


def _open(order: Order) -> "Model | None":
    """The model, after a trial; None where it was refused."""
    try:
        _use_cores(order.config.cpus)
        import cv2

        from edge.segmenter.model import Model

        cv2.setNumThreads(1)
        return Model(Path(order.model), order.config)
    except ImportError as error:
        reason = f"needs onnxruntime ({error}): pip install onnxruntime"
    except EdgeError as error:
        reason = str(error)
    except MemoryError:
        reason = f"{order.model}: needs more than memory_mb = {order.config.memory_mb}"
    send(order.answers_fd, Refused(reason))
    return None


def _answer(order: Order, model: "Model", memory: ImageMemory, mark: int) -> None:
    began_ns = time.process_time_ns()
    try:
        detections = model.segment(memory.image)
    except ModelRefused as error:
        send(order.answers_fd, Failed(mark, str(error)))
        return
    except Exception as error:  # noqa: BLE001  # outputs of a form that they had not in the trial
        reason = f"{order.model}: cannot be read: {type(error).__name__}: {error}"
        send(order.answers_fd, Failed(mark, " ".join(reason.split())[:300]))
        return
    ms = (time.process_time_ns() - began_ns) / 1e6
    send(order.answers_fd, pack(mark, detections, ms, _rss_mb()))


def _rss_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1e6


if __name__ == "__main__":
    sys.exit(main())
