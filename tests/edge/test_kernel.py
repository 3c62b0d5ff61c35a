# SPDX-License-Identifier: Apache-2.0
"""The compiler flags that speed and safety rest on."""

import math
import re

import numpy as np

from edge.kernel import inline_kernel, kernel
from edge.types import F32, I32


@kernel
def blend(image: F32, index: I32, share: F32, out: F32) -> None:
    """Gather from one array and store to another in the same loop."""
    for i in range(out.shape[0]):
        at = index[i]
        a, b = image[at], image[at + np.int32(1)]
        out[i] = a + share[i] * (b - a) + share[i] * share[i] * (a * b)


@kernel
def count_nan(values: F32) -> int:
    count = 0
    for i in range(values.shape[0]):
        if values[i] != values[i]:
            count += 1
    return count


@inline_kernel
def is_bad(value: np.float32) -> bool:
    return math.isnan(value) or math.isinf(value)


@kernel
def clean(values: F32, out: F32) -> None:
    for i in range(values.shape[0]):
        out[i] = np.float32(-1.0) if is_bad(values[i]) else values[i] * np.float32(2.0)


@kernel
def divide(a: float, b: float) -> float:
    return a / b


def test_a_loop_that_gathers_and_stores_is_vectorised() -> None:
    rng = np.random.default_rng(0)
    image = rng.uniform(0.0, 255.0, 1001).astype(np.float32)
    index = rng.integers(0, 1000, 500, np.int32)
    share = rng.uniform(0.0, 1.0, 500).astype(np.float32)
    out = np.empty(500, np.float32)
    blend(image, index, share, out)

    a, b = image[index], image[index + 1]
    np.testing.assert_allclose(out, a + share * (b - a) + share**2 * a * b, rtol=1e-5)
    blend.recompile()  # code from the disk cache cannot be looked into
    (code,) = blend.inspect_llvm().values()
    assert re.search(r"f(mul|add|sub)[a-z ]* <\d+ x float>", code), "the compiler feared an overlap"


def test_nan_is_still_found() -> None:
    values = np.ones(1000, np.float32)
    values[::5] = np.nan
    assert count_nan(values) == 200


def test_isnan_and_isinf_work_in_inlined_helpers() -> None:
    values = np.array([1.0, np.nan, np.inf, -np.inf, 3.0] * 40, np.float32)
    out = np.empty_like(values)
    clean(values, out)
    assert np.array_equal(out, np.array([2.0, -1.0, -1.0, -1.0, 6.0] * 40, np.float32))


def test_division_by_zero_gives_infinity_as_in_numpy() -> None:
    assert divide(1.0, 0.0) == math.inf
    assert math.isnan(divide(0.0, 0.0))


def test_read_only_arrays_are_accepted() -> None:
    values = np.ones(10, np.float32)
    values.flags.writeable = False
    assert count_nan(values) == 0
