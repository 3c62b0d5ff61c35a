# SPDX-License-Identifier: Apache-2.0
"""What a map holds, as a picture: from above and from the side."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from edge.errors import OutputError
from edge.runtime.plot import MAX_TILT_COS, save
from edge.tiles.labels import read_labels
from edge.tiles.reader import Map, open_map
from edge.types import F64, I32, Bools

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection

_MAX_POINTS_DRAWN = 60_000
_MAX_FRUSTA_DRAWN = 60
_MAX_LABELS_NAMED = 12  # those of most points
_CAMERA, _LINE = "crimson", "black"
_AXES = (("x", "tab:red"), ("y", "tab:green"), ("z", "tab:blue"))


class _Group(NamedTuple):
    """Points that look alike."""

    chosen: Bools  # (n,) which
    name: str | None
    colour: str | F64


class _Scene(NamedTuple):
    """What of a map is drawn, turned so that z points up."""

    T_paper_map: F64  # (4, 4)
    names: tuple[str, str, str]  # of the axes
    points: F64  # (n, 3)
    groups: list[_Group]
    cameras: F64  # (k, 3)
    frusta: F64  # (m, 10, 3)
    lines: F64  # (l, 2, 3) ends
    unit: str


def draw(folder: Path, picture: Path) -> None:
    """Write a picture of points, lines and cameras from above and from the side."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise OutputError("--picture needs matplotlib; install mapvo[maps]") from None

    opened = open_map(folder)
    scene = _scene(opened)
    figure = Figure(figsize=(16, 8), dpi=100, layout="constrained")
    above, side = figure.subplots(1, 2)
    shaded = _draw_side(above, scene, 1, "from above")
    _draw_side(side, scene, 2, "from the side")
    figure.legend(
        *above.get_legend_handles_labels(), loc="outside lower left", ncols=8, markerscale=3.0
    )
    if scene.groups[0].name is None:
        bar = figure.colorbar(shaded, ax=[above, side], label="images that see a point", shrink=0.6)
        bar.ax.yaxis.set_major_formatter(lambda power, _: f"{2.0**power:.0f}")
    figure.suptitle(_title(folder, opened))
    save(figure, picture)


def _title(folder: Path, opened: Map) -> str:
    levelled = opened.manifest.T_local_map is not None
    up = "levelled" if levelled else "up is how the cameras were held"
    return f"{folder.name}: {opened.n_keyframes} keyframes, {opened.n_points} points, {up}"


def _scene(opened: Map) -> _Scene:
    rows = _points_to_draw(opened)
    found = opened.points(rows)
    placed = opened.manifest.T_local_map
    T = np.eye(4) if placed is None else np.array(placed)
    if placed is None:
        T[:3, :3] = _level(_up(opened))
    cameras = opened.T_map_cam[:, :3, 3]
    both = np.vstack((found.xyz, cameras))
    extent = float(np.linalg.norm(np.ptp(np.percentile(both, (5, 95), 0), 0)))
    shades = np.log2(found.n_views.astype(np.float64))

    def turned(places: F64) -> F64:
        moved: F64 = places @ T[:3, :3].T + T[:3, 3]
        return moved

    return _Scene(
        T,
        _names(opened),
        turned(found.xyz),
        _by_label(opened, rows) or [_Group(rows >= 0, None, shades)],
        turned(cameras),
        turned(_frusta(opened, extent)),
        turned(_line_ends(opened)),
        "m" if opened.manifest.metric else "units of the map, not metres",
    )


def _draw_side(axes: "Axes", scene: _Scene, upward: int, title: str) -> "PathCollection":
    """One view: the first axis to the right, the one called `upward` up; what was shaded."""
    for group in scene.groups:
        x, y = scene.points[group.chosen][:, (0, upward)].T
        shaded = axes.scatter(x, y, s=1.5, c=group.colour, label=group.name, linewidths=0)
    lines = scene.lines[:, :, (0, upward)]
    for number, ends in enumerate(lines):
        axes.plot(*ends.T, color=_LINE, lw=0.8, label=None if number else "lines")
    for number, frustum in enumerate(scene.frusta[:, :, (0, upward)]):
        label = None if number else "where the cameras looked"
        axes.plot(*frustum.T, color=_CAMERA, lw=0.5, alpha=0.6, label=label)
    axes.plot(*scene.cameras[:, (0, upward)].T, ".", color=_CAMERA, ms=4, label="keyframes")
    _draw_map_axes(axes, scene, upward)
    inner = np.percentile(scene.points[:, (0, upward)], (0.5, 99.5), axis=0)
    shown = np.vstack((inner, scene.cameras[:, (0, upward)]))
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.05 * float(np.linalg.norm(high - low))
    axes.set(aspect="equal", title=title)
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_xlabel(f"{scene.names[0]} [{scene.unit}]")
    axes.set_ylabel(f"{scene.names[upward]} [{scene.unit}]")
    axes.grid(visible=True, alpha=0.3)
    return shaded


def _draw_map_axes(axes: "Axes", scene: _Scene, upward: int) -> None:
    """Where the map's own axes point, at its origin."""
    length = 0.08 * float(np.linalg.norm(np.ptp(scene.cameras, axis=0))) + 1e-9
    for i, (name, colour) in enumerate(_AXES):
        along = length * scene.T_paper_map[(0, upward), i]
        origin = scene.T_paper_map[(0, upward), 3]
        if np.linalg.norm(along) > 0.3 * length:  # else it points at the reader
            axes.annotate(
                name,
                tuple(origin),
                tuple(origin + along),
                color=colour,
                ha="center",
                va="center",
                arrowprops={"arrowstyle": "<-", "color": colour, "shrinkA": 0, "shrinkB": 0},
                annotation_clip=True,
            )


def _names(opened: Map) -> tuple[str, str, str]:
    """What the axes of the paper are called: those of the levelled map, its own, or neither."""
    if opened.manifest.T_local_map is not None:
        return "x, levelled", "y, levelled", "z, levelled"
    names = ["level", "level", "up"]
    for k, direction in enumerate(_level(_up(opened))):
        i = int(np.argmax(np.abs(direction)))
        if abs(direction[i]) > 1.0 - 1e-6:
            names[k] = ("" if direction[i] > 0.0 else "-") + "xyz"[i]
    return names[0], names[1], names[2]


def _points_to_draw(opened: Map) -> I32:
    """Points (n,) that are known to a few percent."""
    step = max(1, opened.n_points // _MAX_POINTS_DRAWN)
    rows = np.arange(0, opened.n_points, step, dtype=np.int32)
    sigma = np.sqrt(np.linalg.eigvalsh(opened.points(rows).covariance)[:, 2])
    return rows[sigma <= np.percentile(sigma, 90)] if len(sigma) else rows


def _by_label(opened: Map, rows: I32) -> list[_Group]:
    """Which of the points `rows` each class has, its name and a colour; none without labels."""
    labels = read_labels(opened)
    if labels is None:
        return []
    classes = labels.point_class[rows]
    groups = [_Group(classes < 0, "no label", "lightgrey")]
    counts = np.bincount(classes[classes >= 0], minlength=len(labels.names))
    order = [int(i) for i in np.argsort(-counts, kind="stable") if counts[i]]
    for place, label in enumerate(order):
        named = place < _MAX_LABELS_NAMED
        name = labels.names[label] if named else "_" + labels.names[label]  # _: not in the legend
        groups.append(_Group(classes == label, name, f"C{place % 10}"))
    return groups


def _line_ends(opened: Map) -> F64:
    """First and last places (n, 2, 3) where the map's lines were seen."""
    found = opened.lines.take(np.arange(opened.lines.count, dtype=np.int32))
    away = found.span[:, :, None] * found.lines.direction[:, None]
    ends: F64 = found.lines.point[:, None] + away
    return ends


def _up(opened: Map) -> F64:
    """Which way is up (3,): as the cameras were held, or the map's axis that is near to it."""
    up = -opened.T_map_cam[:, :3, 1].mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    i = int(np.argmax(np.abs(up)))
    return np.eye(3)[i] * np.sign(up[i]) if abs(up[i]) > MAX_TILT_COS else np.asarray(up)


def _level(up: F64) -> F64:
    """Rotation (3, 3) that turns `up` to +z."""
    x = np.cross((0.0, 1.0, 0.0) if abs(up[1]) < 0.9 else (0.0, 0.0, 1.0), up)
    x /= np.linalg.norm(x)
    return np.stack((x, np.cross(up, x), up))


def _frusta(opened: Map, extent: float) -> F64:
    """Outlines (n, 10, 3) of some cameras, each to be drawn in one go."""
    step = max(1, opened.n_keyframes // _MAX_FRUSTA_DRAWN)
    camera = opened.camera
    depth = 0.03 * extent
    x = np.array([-camera.cx, camera.width - camera.cx]) / camera.fx * depth
    y = np.array([-camera.cy, camera.height - camera.cy]) / camera.fy * depth
    a, b, c, d = ((x[i], y[j], depth) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    centre = (0.0, 0.0, 0.0)
    outline = np.array([a, b, c, d, a, centre, b, c, centre, d])
    T = opened.T_map_cam[::step]
    frusta: F64 = np.einsum("nij,kj->nki", T[:, :3, :3], outline) + T[:, None, :3, 3]
    return frusta
