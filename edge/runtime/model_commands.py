# SPDX-License-Identifier: Apache-2.0
"""What `mapvo model` does."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from edge.cameras.images import read_rgb
from edge.config.segmenter import SegmenterConfig
from edge.errors import ModelRefused, OutputError
from edge.segmenter.contract import Contract
from edge.segmenter.picture import draw
from edge.segmenter.process import SegmenterProcess
from edge.store.durable import write_whole
from edge.types import U8, Detections

# ruff: noqa: T201  # printing is what this module is for

_POLL_S = 0.2
_BLANK = (480, 640, 3)  # stands for an image where none is given
_SHOWN_NAMES = 10
_FITS = {
    "centre": "scaled to fit, centred",
    "corner": "scaled to fit, top left",
    "stretch": "stretched",
}


def check(args: argparse.Namespace) -> int:
    """`mapvo model check`."""
    image = read_rgb(args.image) if args.image else np.full(_BLANK, 114, np.uint8)
    out = args.out or Path(f"{args.image.stem if args.image else ''}-masks.png")
    if args.out is not None and args.image is None:
        raise OutputError(f"{out}: there is nothing to draw: give an IMAGE, too")
    if not out.parent.is_dir():
        raise OutputError(f"{out}: cannot be written: {out.parent} is no folder; make it first")
    try:
        _check_segmentation(args, image, out)
    except ModelRefused as refusal:
        drawn = _check_features(args, image if args.image else None, refusal)
        if drawn is not None:
            _save(out, drawn)
    return 0


def _check_features(args: argparse.Namespace, image: U8 | None, refusal: ModelRefused) -> U8 | None:
    """Try it as a model of features; what it sees, or the refusal if it is none either."""
    from edge.runtime.feature_model_check import check_features

    try:
        return check_features(args.model, image)
    except ModelRefused:
        raise refusal from None


def _check_segmentation(args: argparse.Namespace, image: U8, out: Path) -> None:
    with _open(args.model, image.shape) as process:
        assert process.contract is not None
        for line in describe(process.contract):
            print(line)
        detections = _segment(args.model, process, image)
        status = process.status
        print(f"runs      {status.ms:.0f} ms of processor time an image, {status.rss_mb:.0f} MB")
        if args.image:
            _report(args.image, out, image, detections, process.contract)


def describe(contract: Contract) -> list[str]:
    """How a model is understood, in lines for a person."""
    form, output = contract.input, contract.output
    mean, std = (" ".join(f"{v:g}" for v in dict.fromkeys(c)) for c in (form.mean, form.std))
    names = ", ".join(contract.names[:_SHOWN_NAMES])
    more = ", ..." if len(contract.names) > _SHOWN_NAMES else ""
    roles = {name: role for role, name in output.roles.items()}
    lines = [
        f"form      {output.convention}, known from {contract.source}",
        f"input     {form.name} {form.dtype} {form.layout} {form.width}x{form.height}, "
        f"{form.channels}, {_FITS[form.fit]}, pad {form.pad}, (pixel - {mean}) / {std}",
    ]
    lines += [
        f"output    {tensor}: {roles.get(tensor.name, 'not used')}" for tensor in contract.outputs
    ]
    lines.append(f"classes   {len(contract.names)}: {names}{more}")
    return lines + [f"warning   {warning}" for warning in contract.warnings]


@contextmanager
def _open(model: Path, shape: tuple[int, ...]) -> Iterator[SegmenterProcess]:
    process = SegmenterProcess(model, shape, SegmenterConfig())
    try:
        while process.status.state == "starting":
            process.poll(_POLL_S)
        _check_alive(model, process)
        yield process
    finally:
        process.close()


def _segment(model: Path, process: SegmenterProcess, image: U8) -> Detections:
    process.offer(1, image)
    while process.status.state == "busy":
        if (found := process.poll(_POLL_S)) is not None:
            return found.detections
    _check_alive(model, process)
    raise ModelRefused(process.status.reason)


def _check_alive(model: Path, process: SegmenterProcess) -> None:
    status = process.status
    if status.state == "refused":
        raise ModelRefused(status.reason)
    if status.state == "waiting":
        raise ModelRefused(f"{model}: {status.reason}; it would be started again and again")


def _report(source: Path, out: Path, image: U8, detections: Detections, contract: Contract) -> None:
    print(f"seen      {len(detections.masks)} in {source}")
    for i, mask in enumerate(detections.masks):
        left, top, right, bottom = detections.boxes[i]
        print(
            f"          {contract.names[detections.classes[i]]} {detections.scores[i]:.2f}, "
            f"{left:.0f},{top:.0f} to {right:.0f},{bottom:.0f}, {mask.inside.sum()} px"
        )
    _save(out, draw(image, detections, contract.names))


def _save(out: Path, drawn: U8) -> None:
    picture = cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR)
    try:
        write_whole(out, cv2.imencode(out.suffix, picture)[1].tobytes())
    except OSError as error:
        raise OutputError(
            f"{out}: cannot be written: {error.strerror}; name another place"
        ) from error
    print(f"picture   {out}")
