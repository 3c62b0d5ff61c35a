# SPDX-License-Identifier: Apache-2.0
"""Which convention a model follows, from the shapes of what it gives.

A number alone never decides: widths like 116 fit several conventions. What decides is how many
outputs there are, of which rank, and whether an axis counts the cells of the three grids that
dense heads have (strides 8, 16 and 32).
"""

from collections.abc import Sequence

from edge.errors import ModelRefused
from edge.onnx.tensor import Tensor
from edge.segmenter.contract import Convention, OutputForm

STRIDES = (8, 16, 32)
_ANCHORS = 3  # a cell, in YOLOv5
_BOX, _BOX_AND_OBJECT = 4, 5  # columns before the classes: YOLOv8/11, YOLOv5
_LISTED = 6  # columns before the coefficients where the graph itself picks: box, score, class
_YOLACT_ROLES = ("loc", "conf", "mask", "proto", "priors")
# Rank of each output, and whether it is of whole numbers.
_RTMDET = {"dets": (3, False), "labels": (2, True), "masks": (4, False)}
_MASK_RCNN = {"boxes": (2, False), "labels": (1, True), "scores": (1, False), "masks": (4, False)}
_SIDECAR = "say what it is in the sidecar MODEL.onnx.toml"


def count_cells(width: int, height: int) -> int:
    """Cells of the grids of a dense head."""
    return sum(-(-width // s) * -(-height // s) for s in STRIDES)


def refuse(why: str, tensors: Sequence[Tensor]) -> ModelRefused:
    """The refusal, with the shapes of the outputs."""
    shapes = ", ".join(str(tensor) for tensor in tensors) or "none"
    return ModelRefused(f"{why}; outputs: {shapes}")


def recognise(
    outputs: Sequence[Tensor],
    size: tuple[int, int],
    n_names: int | None,
    declared: Convention | None = None,
    named: dict[str, str] | None = None,
) -> OutputForm:
    """How to read the outputs of one run.

    `size` is the input's (width, height), `n_names` how many classes are named, `declared` and
    `named` what a sidecar says of convention and outputs. Raises ModelRefused.
    """
    if declared == "yolact":
        return _yolact(outputs, named or {})
    roles = _read_listed_roles(outputs) or _read_dense_roles(outputs)
    if roles is None:
        if not any(len(tensor.shape) == 4 for tensor in outputs):
            raise refuse("it finds boxes only, no masks: a segmentation model is needed", outputs)
        raise refuse(f"it is of no known form: {_SIDECAR}", outputs)
    by_name = {tensor.name: tensor for tensor in outputs}
    if "dets" in roles:
        form = _rtmdet(by_name, roles, size, outputs)
    elif "boxes" in roles:
        form = OutputForm("maskrcnn", roles)
    else:
        form = _with_prototypes(by_name, roles, size, n_names, outputs, declared)
    if declared is not None and form.convention != declared:
        why = f"its sidecar says {declared}, but its outputs are those of {form.convention}"
        raise refuse(why, outputs)
    return form


def _read_listed_roles(outputs: Sequence[Tensor]) -> dict[str, str] | None:
    """Roles of the outputs of RTMDet-Ins or Mask R-CNN, told by rank and type."""
    found = {(len(tensor.shape), "int" in tensor.dtype): tensor for tensor in outputs}
    for roles in (_RTMDET, _MASK_RCNN):
        if len(outputs) != len(roles) or found.keys() != set(roles.values()):
            continue
        named = {role: found[kind] for role, kind in roles.items()}
        boxes, columns = (named["dets"], 5) if "dets" in named else (named["boxes"], 4)
        if boxes.shape[-1] == columns and (columns == 5 or named["masks"].shape[1] == 1):
            return {role: tensor.name for role, tensor in named.items()}
    return None


def _read_dense_roles(outputs: Sequence[Tensor]) -> dict[str, str] | None:
    heads = [tensor for tensor in outputs if len(tensor.shape) == 3]
    prototypes = [tensor for tensor in outputs if len(tensor.shape) == 4]
    if len(heads) != 1 or len(prototypes) != 1:
        return None
    return {"head": heads[0].name, "prototypes": prototypes[0].name}


def _rtmdet(
    by_name: dict[str, Tensor],
    roles: dict[str, str],
    size: tuple[int, int],
    outputs: Sequence[Tensor],
) -> OutputForm:
    masks = by_name[roles["masks"]].shape
    if masks[2:] != (size[1], size[0]):
        why = f"its masks are not of the input's size {size[0]}x{size[1]}, as those of RTMDet-Ins"
        raise refuse(f"{why}; export it with whole-image masks", outputs)
    return OutputForm("rtmdet", roles)


def _with_prototypes(  # one table of cases
    by_name: dict[str, Tensor],
    roles: dict[str, str],
    size: tuple[int, int],
    n_names: int | None,
    outputs: Sequence[Tensor],
    declared: Convention | None,
) -> OutputForm:
    """A head with mask coefficients beside prototypes: dense, or picked by the graph itself."""
    _, first, last = by_name[roles["head"]].shape
    n_prototypes = by_name[roles["prototypes"]].shape[1]
    cells = count_cells(*size)
    counts = (cells, _ANCHORS * cells)
    is_listed = last == _LISTED + n_prototypes
    if declared == "end2end" and is_listed:
        return OutputForm("end2end", roles)
    wrong = ""
    for columns_first, rows, columns in ((True, last, first), (False, first, last)):
        if rows not in counts:
            continue
        rest = columns - n_prototypes
        usual = _BOX if rows == cells else _BOX_AND_OBJECT
        extra = rest - n_names if n_names is not None else usual
        kind: Convention = "yolov8" if extra == _BOX else "yolov5"
        # One name too few would make a YOLOv8 a YOLOv5: only a sidecar may say what is unusual.
        if extra in (_BOX, _BOX_AND_OBJECT) and rest > extra and (extra == usual or declared):
            return OutputForm(kind, roles, rest - extra, columns_first)
        wrong = f"it is told {n_names} names of classes, but its outputs are for {rest - usual}"
    if is_listed:
        return OutputForm("end2end", roles)
    if wrong:
        raise refuse(f"{wrong}: give the names it was trained with", outputs)
    why = f"no axis of {roles['head']} is {counts[0]} or {counts[1]}, the cells of a dense head"
    raise refuse(f"{why}, nor is its last {_LISTED + n_prototypes}: {_SIDECAR}", outputs)


def _yolact(outputs: Sequence[Tensor], named: dict[str, str]) -> OutputForm:
    """Five outputs that a sidecar names, or that bear YOLACT's own names."""
    by_name = {tensor.name: tensor for tensor in outputs}
    roles = {role: named.get(role, role) for role in _YOLACT_ROLES}
    missing = [f"{role} = {name!r}" for role, name in roles.items() if name not in by_name]
    if missing:
        why = f"its sidecar's [outputs] names what is not there: {', '.join(missing)}"
        raise refuse(why, outputs)
    loc, conf, mask, proto, priors = (by_name[roles[role]].shape for role in _YOLACT_ROLES)
    n = priors[0] if len(priors) == 2 else -1
    is_right = (
        [len(shape) for shape in (loc, conf, mask, proto)] == [3, 3, 3, 4]
        and loc[1:] == (n, 4)
        and priors[1] == 4
        and conf[1] == mask[1] == n
        and proto[3] == mask[2]
        and conf[2] > 1
    )
    if not is_right:
        raise refuse("its outputs do not fit YOLACT's", outputs)
    return OutputForm("yolact", roles, conf[2] - 1)
