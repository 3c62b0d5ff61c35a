# SPDX-License-Identifier: Apache-2.0
"""Kinds of numbers that settings are."""

from typing import Annotated

from msgspec import Meta

Amount = Annotated[float, Meta(ge=0.0, le=1e6)]
Positive = Annotated[float, Meta(gt=0.0, le=1e6)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Probability = Annotated[float, Meta(gt=0.0, lt=1.0)]
Whole = Annotated[int, Meta(ge=0, le=100_000)]
Count = Annotated[int, Meta(ge=1, le=100_000)]
