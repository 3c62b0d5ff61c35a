# SPDX-License-Identifier: Apache-2.0
"""The one place where Numba's compiler flags are set."""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba
from numba.core.compiler import CompilerBase, DefaultPassBuilder

from edge.kernel_files import distrust
from edge.kernel_loading import load_lean

P = ParamSpec("P")
R = TypeVar("R")

# All of LLVM's fast-math but nnan and ninf: with those, isnan() finds nothing.
FASTMATH = {"reassoc", "contract", "arcp", "nsz"}


load_lean()
distrust()


class _NoAliasCompiler(CompilerBase):  # type: ignore[misc]  # numba ships no types
    """Promises LLVM that array arguments do not overlap.

    Without it no loop is vectorised that both gathers from an image and stores
    to an array. It is an internal flag: the range of Numba is pinned for it.
    """

    def define_pipelines(self) -> list[Any]:
        self.state.flags.noalias = True
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` at its first call, without the GIL, cached on disk.

    Array arguments must not overlap. Annotations are kept for the type checker.
    """
    compiled = numba.njit(  # noqa: TID251  # this is that one place
        cache=True,
        nogil=True,
        fastmath=FASTMATH,
        error_model="numpy",
        pipeline_class=_NoAliasCompiler,
    )(function)
    return cast("Callable[P, R]", compiled)


def inline_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small scalar helper that is always inlined into its callers."""
    compiled = numba.njit(  # noqa: TID251
        cache=True,
        nogil=True,
        fastmath=FASTMATH,
        error_model="numpy",
        forceinline=True,
    )(function)
    return cast("Callable[P, R]", compiled)
