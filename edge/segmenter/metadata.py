# SPDX-License-Identifier: Apache-2.0
"""What exporters write into a model beside its graph. It is text from outside: never evaluated."""

import ast
from collections.abc import Mapping
from typing import Any

from edge.errors import ModelRefused

_MAX_TEXT = 1_000_000  # of a literal; longer ones take the parser's memory
_MAX_CLASSES = 100_000


def read_names(metadata: Mapping[str, str]) -> tuple[str, ...] | None:
    """Names of the classes in their order; None where it has none."""
    text = metadata.get("names")
    if not text:
        return None
    value = _literal("names", text)
    if isinstance(value, dict):
        value = {_number(key): name for key, name in value.items()}
        if sorted(value, key=str) != sorted(range(len(value)), key=str):
            raise ModelRefused("its metadata `names` does not number the classes 0, 1, 2, ...")
        value = [value[i] for i in range(len(value))]
    if not isinstance(value, list | tuple) or not 0 < len(value) <= _MAX_CLASSES:
        raise ModelRefused("its metadata `names` is no list of classes: give names in the sidecar")
    if not all(isinstance(name, str) and name for name in value):
        raise ModelRefused("its metadata `names` holds a class without a name")
    return tuple(value)


def read_size(metadata: Mapping[str, str]) -> tuple[int, int] | None:
    """Width and height that the model was exported for; None where it does not say."""
    text = metadata.get("imgsz")
    if not text:
        return None
    value = _literal("imgsz", text)
    if isinstance(value, int):
        value = [value, value]
    is_pair = isinstance(value, list | tuple) and len(value) == 2
    if not is_pair or not all(type(size) is int and 32 <= size <= 4096 for size in value):
        raise ModelRefused(f"its metadata `imgsz` is {text[:40]!r}, no size")
    return value[1], value[0]


def check_task(metadata: Mapping[str, str]) -> None:
    """Refuse what says of itself that it is no segmentation model."""
    task = metadata.get("task", "segment")
    if task != "segment":
        raise ModelRefused(
            f"its metadata says task {task[:40]!r}; an instance-segmentation model is needed"
        )


def _number(key: Any) -> Any:
    """JSON knows no numbers as keys."""
    return int(key) if isinstance(key, str) and key.isdecimal() and len(key) < 7 else key


def _literal(key: str, text: str) -> Any:
    if len(text) > _MAX_TEXT:
        raise ModelRefused(f"its metadata `{key}` is {len(text)} characters long")
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError):
        raise ModelRefused(
            f"its metadata `{key}` cannot be read: {text[:40]!r}; give it in the sidecar"
        ) from None
