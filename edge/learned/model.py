# SPDX-License-Identifier: Apache-2.0
"""A model of features: opened, tried out, and its origin measured.

It loads ONNX Runtime, so it is imported only where a setting names a model.
"""

import hashlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.errors import ModelRefused
from edge.learned.codes import encode, planes
from edge.learned.contract import recognise, settle_input
from edge.learned.maps import Found, read_maps, unit
from edge.learned.picture import picture
from edge.onnx import session as onnx_session
from edge.onnx.outline import look_into
from edge.types import F32, U8

_TRIED_PX = (640, 480)
_TRIED_COUNT = 1000


class LearnedModel:
    """A model that finds and describes key points. Owned by one thread.

    Raises ModelRefused, in one line, where it cannot be used.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        file = look_into(path)
        self.sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        try:
            self._session = onnx_session.open_session(path, file)
            self._input = settle_input(onnx_session.inputs_of(self._session))
            self._try_out()
        except ModelRefused as error:
            raise ModelRefused(f"{path}: {error}") from error

    def find(self, image: U8, count: int) -> Found:
        """The best `count` key points of a grey image (h, w), in its own pixels."""
        height, width = image.shape
        size = self._input.size_for(width, height)
        resized = image if size == (width, height) else _resized(image, size)
        found = self._read(self._run(resized), count)
        usable = np.isfinite(found.descriptors).all(axis=1) & np.isfinite(found.pixels).all(axis=1)
        ratio = np.array((width / size[0], height / size[1]), np.float32)
        return Found(
            (found.pixels[usable] + np.float32(0.5)) * ratio - np.float32(0.5),
            found.scores[usable],
            found.descriptors[usable],
        )

    def codes(self, found: Found) -> U8:
        """Codes (n, 32) of what was found."""
        return encode(found.descriptors, self._origin, self._planes)

    def describe(self) -> list[str]:
        """How it is understood, in lines for a person."""
        form, taken = self._form, self._input
        size = f"{taken.width}x{taken.height}" if taken.width and taken.height else "any size"
        kind = "maps of the image" if form.kind == "maps" else "lists of points"
        return [
            f"form      features as {kind}: {form.places}, {form.descriptors}",
            f"input     {taken.name}, {taken.channels} channels, {size}, 0 to 1",
            f"gives     descriptors of {form.dimensions} numbers",
        ]

    def _try_out(self) -> None:
        """Settle what the outputs are, and around which origin descriptors lie."""
        size = self._input.size_for(*_TRIED_PX)
        outputs = self._run(picture(*size))
        self._form = recognise(outputs, *size)
        found = self._read(outputs, _TRIED_COUNT)
        if not (len(found.pixels) and np.isfinite(found.descriptors).all()):
            raise ModelRefused("it gives nothing, or what is no number, for a picture of corners")
        self._origin = found.descriptors.mean(axis=0)
        self._planes = planes(self._form.dimensions)
        self._read(self._run(np.zeros(size[::-1], np.uint8)), _TRIED_COUNT)

    def _run(self, image: U8) -> dict[str, NDArray[Any]]:
        grey = image.astype(np.float32) / np.float32(255.0)
        feed = np.repeat(grey[None, None], self._input.channels, axis=1)
        what = f"{image.shape[1]}x{image.shape[0]}"
        return onnx_session.run(self._session, {self._input.name: feed}, what)

    def _read(self, outputs: dict[str, NDArray[Any]], count: int) -> Found:
        form = self._form
        places, told = (_floats(outputs[name]) for name in (form.places, form.descriptors))
        worth = None if form.worth is None else _floats(outputs[form.worth])
        if form.kind == "maps":
            return read_maps(places[0], told[0], None if worth is None else worth[0], count)
        # A single key point leaves no shape that tells which axis is that of images.
        pixels, descriptors = places.reshape(-1, 2), told.reshape(-1, form.dimensions)
        score = np.ones(len(pixels), np.float32) if worth is None else worth.reshape(-1)
        best = np.argsort(-score, kind="stable")[:count]
        best = best[score[best] > 0.0]  # exporters fill up with zeros
        return Found(pixels[best], score[best], unit(descriptors[best]))


def _resized(image: U8, size: tuple[int, int]) -> U8:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _floats(array: NDArray[Any]) -> F32:
    return np.ascontiguousarray(array, np.float32)
