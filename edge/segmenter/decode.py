# SPDX-License-Identifier: Apache-2.0
"""Turns what a model gives into detections in the image's pixels."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.config.segmenter import SegmenterConfig
from edge.errors import ModelRefused
from edge.segmenter.contract import Contract, Convention
from edge.segmenter.letterbox import Letterbox, boxes_to_image
from edge.segmenter.masks import sample_plane
from edge.types import F32, I32, Detections, Mask

Outputs: TypeAlias = Mapping[str, NDArray[Any]]  # by role

_MAX_CANDIDATES = 1000  # before overlapping ones are dropped; bounds the time of a wild frame
_SCORE_SLACK = 1e-3  # 16-bit sigmoids end a little above 1
_MASK_LOGIT, _MASK_SHARE = 0.0, 0.5


class Found(NamedTuple):
    """Objects in the model's input, best first."""

    boxes: F32  # (n, 4) left, top, right, bottom, as the model counts
    scores: F32  # (n,)
    classes: I32  # (n,)
    rows: I32  # (n,) where the rest of each stands in the outputs


def decode(
    outputs: Outputs, contract: Contract, letterbox: Letterbox, config: SegmenterConfig
) -> Detections:
    """Detections of one run. Raises ModelRefused where the outputs are nonsense."""
    _check(outputs, contract)
    finder, masker = _READERS[contract.output.convention]
    found = finder(outputs, contract, config)
    if len(found.classes) and not 0 <= found.classes.min() <= found.classes.max() < len(
        contract.names
    ):
        worst = int(found.classes.max())
        raise ModelRefused(
            f"it gives class {worst}, but {len(contract.names)} are named: name all of them"
        )
    boxes = boxes_to_image(letterbox, found.boxes)
    kept, masks = [], []
    for i in range(min(len(boxes), config.max_objects)):
        mask = masker(outputs, contract, found, boxes, i, letterbox)
        if mask is not None:
            kept.append(i)
            masks.append(mask)
    arrays = boxes[kept], found.scores[kept], found.classes[kept]
    for array in arrays:
        array.flags.writeable = False
    return Detections(*arrays, tuple(masks))


def _check(outputs: Outputs, contract: Contract) -> None:
    for role, array in outputs.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            name = contract.output.roles[role]
            raise ModelRefused(f"its output {name} holds NaN or infinite numbers")


def check_scores(scores: NDArray[Any]) -> None:
    """Refuse scores that are no probabilities."""
    if scores.size == 0:
        return
    low, high = float(scores.min()), float(scores.max())
    if low < -_SCORE_SLACK or high > 1.0 + _SCORE_SLACK:
        raise ModelRefused(
            f"its scores reach from {low:.3g} to {high:.3g}, not 0 to 1: export it with sigmoid"
        )


def choose(
    boxes: NDArray[Any], scores: F32, classes: NDArray[Any], rows: I32, config: SegmenterConfig
) -> Found:
    """Those above the least score, the best of overlapping ones, whatever they are called."""
    order = np.argsort(-scores, kind="stable")[:_MAX_CANDIDATES]
    order = order[scores[order] >= config.min_score]
    chosen = boxes[order].astype(np.float32)
    extents = np.concatenate([chosen[:, :2], chosen[:, 2:] - chosen[:, :2]], axis=1)
    good = (extents[:, 2:] > 0.0).all(axis=1)
    order, chosen, extents = order[good], chosen[good], extents[good]
    kept = cv2.dnn.NMSBoxes(
        extents.astype(np.float64).tolist(),
        scores[order].tolist(),
        config.min_score,
        config.same_overlap,
    )
    picks = np.sort(np.asarray(kept, dtype=np.intp).ravel())
    take = order[picks]
    return Found(
        chosen[picks],
        scores[take].astype(np.float32),
        classes[take].astype(np.int32),
        rows[take].astype(np.int32),
    )


def _corners(centred: NDArray[Any]) -> NDArray[Any]:
    half = 0.5 * centred[:, 2:]
    corners: NDArray[Any] = np.concatenate([centred[:, :2] - half, centred[:, :2] + half], axis=1)
    return corners


def _head(outputs: Outputs, contract: Contract) -> NDArray[Any]:
    head: NDArray[Any] = outputs["head"][0]
    return head.T if contract.output.columns_first else head


def _find_dense(outputs: Outputs, contract: Contract, config: SegmenterConfig) -> Found:
    head = _head(outputs, contract)
    begin = 4 if contract.output.convention == "yolov8" else 5
    n_classes = contract.output.n_classes or 0
    by_class = head[:, begin : begin + n_classes]
    scores = by_class.max(axis=1).astype(np.float32)
    check_scores(by_class)
    if begin == 5:
        check_scores(head[:, 4])
        scores = scores * head[:, 4].astype(np.float32)
    # The rest is done for the few that count: there are thousands of cells.
    rows = np.flatnonzero(scores >= config.min_score).astype(np.int32)
    classes = by_class[rows].argmax(axis=1)
    return choose(_corners(head[rows, :4]), scores[rows], classes, rows, config)


def _find_end2end(outputs: Outputs, _contract: Contract, config: SegmenterConfig) -> Found:
    head = outputs["head"][0]
    check_scores(head[:, 4])
    rows = np.arange(len(head), dtype=np.int32)
    return choose(head[:, :4], head[:, 4].astype(np.float32), np.rint(head[:, 5]), rows, config)


def _find_rtmdet(outputs: Outputs, _contract: Contract, config: SegmenterConfig) -> Found:
    dets, labels = outputs["dets"][0], outputs["labels"][0]
    check_scores(dets[:, 4])
    rows = np.arange(len(dets), dtype=np.int32)
    return choose(dets[:, :4], dets[:, 4].astype(np.float32), labels, rows, config)


def _find_maskrcnn(outputs: Outputs, _contract: Contract, config: SegmenterConfig) -> Found:
    scores = outputs["scores"].astype(np.float32)
    check_scores(scores)
    rows = np.arange(len(scores), dtype=np.int32)
    return choose(outputs["boxes"], scores, outputs["labels"], rows, config)


def _find_yolact(outputs: Outputs, contract: Contract, config: SegmenterConfig) -> Found:
    loc, conf, priors = outputs["loc"][0], outputs["conf"][0], outputs["priors"]
    by_class = conf[:, 1:]  # the first is the background
    check_scores(conf)
    # The variances of SSD: 0.1 of places, 0.2 of sizes.
    centre = priors[:, :2] + loc[:, :2] * 0.1 * priors[:, 2:]
    size = priors[:, 2:] * np.exp(np.minimum(loc[:, 2:] * 0.2, 10.0))
    scale = np.array([contract.input.width, contract.input.height] * 2, dtype=np.float32)
    boxes = _corners(np.concatenate([centre, size], axis=1)) * scale
    rows = np.arange(len(boxes), dtype=np.int32)
    scores = by_class.max(axis=1).astype(np.float32)
    return choose(boxes, scores, by_class.argmax(axis=1), rows, config)


def _mask_from_head(  # the common form of all masks
    outputs: Outputs, contract: Contract, found: Found, boxes: F32, i: int, letterbox: Letterbox
) -> Mask | None:
    prototypes = outputs["prototypes"][0]
    n = prototypes.shape[0]
    coefficients = _head(outputs, contract)[found.rows[i], -n:].astype(np.float32)
    flat = prototypes.reshape(n, -1).astype(np.float32, copy=False)
    plane: F32 = (coefficients @ flat).reshape(prototypes.shape[1:])
    return sample_plane(plane, boxes[i], letterbox, _MASK_LOGIT)


def _mask_from_yolact(
    outputs: Outputs, _contract: Contract, found: Found, boxes: F32, i: int, letterbox: Letterbox
) -> Mask | None:
    coefficients = outputs["mask"][0, found.rows[i]].astype(np.float32)
    plane: F32 = outputs["proto"][0].astype(np.float32, copy=False) @ coefficients
    return sample_plane(plane, boxes[i], letterbox, _MASK_LOGIT)


def _mask_whole(
    outputs: Outputs, _contract: Contract, found: Found, boxes: F32, i: int, letterbox: Letterbox
) -> Mask | None:
    masks = outputs["masks"]
    plane = masks[0, found.rows[i]] if masks.shape[0] == 1 else masks[found.rows[i], 0]
    return sample_plane(plane.astype(np.float32), boxes[i], letterbox, _MASK_SHARE)


_Finder: TypeAlias = Callable[[Outputs, Contract, SegmenterConfig], Found]
_Masker: TypeAlias = Callable[[Outputs, Contract, Found, F32, int, Letterbox], Mask | None]
_READERS: dict[Convention, tuple[_Finder, _Masker]] = {
    "yolov8": (_find_dense, _mask_from_head),
    "yolov5": (_find_dense, _mask_from_head),
    "end2end": (_find_end2end, _mask_from_head),
    "rtmdet": (_find_rtmdet, _mask_whole),
    "maskrcnn": (_find_maskrcnn, _mask_whole),
    "yolact": (_find_yolact, _mask_from_yolact),
}
