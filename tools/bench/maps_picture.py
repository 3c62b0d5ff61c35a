# SPDX-License-Identifier: Apache-2.0
"""The growth of maps as a picture."""

import math
from collections.abc import Sequence
from pathlib import Path

PANELS = (
    ("bytes", 1e-6, "map on disk [MB]", 230.0),
    ("open_ms", 1.0, "opening [ms CPU]", 100.0),
    ("retrieve_ms", 1.0, "one retrieval [ms CPU]", 5.0),
    ("resident_mb", 1.0, "memory after 100 localisations [MB]", 300.0),
    ("build_s", 1.0, "build [s CPU]", None),
    ("localise_ms", 1.0, "one localisation [ms CPU]", None),
)


def draw(rows: Sequence[dict[str, float]], picture: Path) -> None:
    """Write a PNG: each figure over the number of keyframes, with its bound."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(13, 7), layout="constrained")
    n = [row["n"] for row in rows]
    for axis, (name, scale, title, bound) in zip(axes.flat, PANELS, strict=True):
        values = [scale * row[name] for row in rows]
        top = 1.1 * max([value for value in values if not math.isnan(value)] + [bound or 0.0])
        axis.plot(n, values, "o-", color="tab:blue")
        if bound is not None:
            axis.axhline(bound, color="tab:red", linestyle="--", linewidth=1.0, label="bound")
            axis.legend()
        axis.set(title=title, xlabel="keyframes", ylim=(0.0, top), xlim=(0, None))
        axis.grid(visible=True, alpha=0.3)
    figure.savefig(picture, dpi=90)
    plt.close(figure)
