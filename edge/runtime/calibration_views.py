# SPDX-License-Identifier: Apache-2.0
"""Which views of a board a calibration is made from, and whether they are enough."""

from collections.abc import Sequence

import numpy as np

from edge.errors import RecordingError
from edge.geometry.calibration import View
from edge.types import F64, Bools

MIN_VIEWS = 8
MAX_VIEWS = 60  # more cost time and hardly help
_CELLS = (6, 8)  # rows and columns that the image is divided into
_MIN_COVERED = 0.5
_THIRDS = (("upper left", "top", "upper right"), ("left", "middle", "right"))
_REGIONS = (*_THIRDS, ("lower left", "bottom", "lower right"))


def choose(views: Sequence[View], width: int, height: int) -> list[int]:
    """Indices of at most MAX_VIEWS views that differ most: by place, size, turn and tilt."""
    if len(views) <= MAX_VIEWS:
        return list(range(len(views)))
    shapes = np.array([_shape(view, width, height) for view in views])
    chosen = [0]
    distance = np.linalg.norm(shapes - shapes[0], axis=1)
    while len(chosen) < MAX_VIEWS:
        farthest = int(np.argmax(distance))
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(shapes - shapes[farthest], axis=1))
    return sorted(chosen)


def covered(views: Sequence[View], width: int, height: int) -> Bools:
    """Whether each cell (rows, columns) of the image holds a corner of some view."""
    rows, columns = _CELLS
    cells = np.zeros(_CELLS, np.bool_)
    for view in views:
        u = np.clip((view.pixels[:, 0] * columns / width).astype(int), 0, columns - 1)
        v = np.clip((view.pixels[:, 1] * rows / height).astype(int), 0, rows - 1)
        cells[v, u] = True
    return cells


def check_enough(views: Sequence[View], images: int, width: int, height: int) -> None:
    """Refuse views that cannot tell a lens; RecordingError says which are missing."""
    if len(views) < MIN_VIEWS:
        raise RecordingError(
            f"only {len(views)} of {images} images show the board well, {MIN_VIEWS} are needed: "
            "check --board and --dictionary, light and focus, or take more"
        )
    cells = covered(views, width, height)
    empty = _empty_regions(cells)
    if empty or cells.mean() < _MIN_COVERED:
        where = f": none is in the {', '.join(empty)}" if empty else ""
        raise RecordingError(
            f"the board's corners cover {cells.mean():.0%} of the image, {_MIN_COVERED:.0%} and "
            f"all its sides are needed{where}: hold it there, too"
        )


def _empty_regions(cells: Bools) -> list[str]:
    """Names of the thirds of the image, by row and column, that no corner is in."""
    rows = np.array_split(np.arange(_CELLS[0]), 3)
    columns = np.array_split(np.arange(_CELLS[1]), 3)
    return [
        _REGIONS[i][j]
        for i, some_rows in enumerate(rows)
        for j, some_columns in enumerate(columns)
        if not cells[np.ix_(some_rows, some_columns)].any()
    ]


def _shape(view: View, width: int, height: int) -> F64:
    """How a view looks: the affine map from the board to the image, as it fits best (6,)."""
    A = np.column_stack((view.points[:, :2], np.ones(len(view.points))))
    fit = np.linalg.lstsq(A, view.pixels / (width, height), rcond=None)[0]
    span = np.ptp(view.points[:, :2], axis=0).max()
    centre = view.pixels.mean(axis=0) / (width, height)
    return np.concatenate((centre, fit[:2].ravel() * span))
