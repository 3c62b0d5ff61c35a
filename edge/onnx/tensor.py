# SPDX-License-Identifier: Apache-2.0
"""An input or output of a model, in words."""

from collections.abc import Mapping
from typing import Any

from msgspec import Struct
from numpy.typing import NDArray


class Tensor(Struct, frozen=True):
    """An input or output; an axis that is not fixed is -1."""

    name: str
    dtype: str
    shape: tuple[int, ...]

    def __str__(self) -> str:
        axes = ",".join("?" if axis < 0 else str(axis) for axis in self.shape)
        return f"{self.name} {self.dtype} [{axes}]"


def tensors(arrays: Mapping[str, NDArray[Any]]) -> tuple[Tensor, ...]:
    """What a model gave."""
    return tuple(Tensor(name, str(a.dtype), a.shape) for name, a in arrays.items())
