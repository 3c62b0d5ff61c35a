# SPDX-License-Identifier: Apache-2.0
"""Draws a run: the path from above on its map, its error, and its states over time."""

import io
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from edge.cameras.groundtruth import GroundTruth
from edge.errors import OutputError
from edge.runtime.run_data import Errors, Poses, RunData, errors_against, read_run, read_truth
from edge.store import durable
from edge.tiles.reader import Map, open_map
from edge.types import F64

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, FAINT, PAPER = "#22272e", "#9aa4af", "#ffffff"
PATH, TRUTH, GOOD, BAD = "#0969da", "#22272e", "#1a7f37", "#cf222e"
MAP_POINT, MAP_KEYFRAME = "#8c959f", "#bf8700"
STATE_COLOURS = {
    "waiting": "#d0d7de",
    "initialising": "#f2cc60",
    "tracking": "#a5d6ff",
    "lost": "#ff8182",
    "on the map": PATH,
}
MAX_DRAWN_POINTS = 60_000
MAX_TILT_COS = 0.94  # 20 degrees: a map whose axis is so near to upright is meant to be level


class View(NamedTuple):
    """A plane to look down on: unit axes (3,) in the map, right and up on the paper."""

    right: F64
    up: F64

    def flat(self, points: F64) -> F64:
        """Places (n, 2) on the paper of points (n, 3)."""
        return np.column_stack((points @ self.right, points @ self.up))


class Backdrop(NamedTuple):
    """What of the map is drawn."""

    points: F64  # (n, 3)
    keyframes: F64  # (k, 4, 4)
    metric: bool


def plot_run(run: Path, out: Path, *, map_folder: Path | None, truth: Path | None) -> None:
    """Write the picture `out` of the run folder `run`."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise OutputError(
            "matplotlib is missing, which draws: install it with `pip install 'mapvo[view]'`"
        ) from error

    data = read_run(run)
    true = None if truth is None else read_truth(truth)
    backdrop = None if map_folder is None else _backdrop(open_map(map_folder))
    errors = None if true is None or len(data.poses.t_ns) == 0 else errors_against(true, data.poses)

    figure = Figure(figsize=(13.0, 7.2), dpi=110, layout="constrained", facecolor=PAPER)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1.0), height_ratios=(3.0, 3.0, 0.7))
    figure.suptitle(_title(data, errors), color=INK, fontsize=12, x=0.01, ha="left")
    _draw_path(figure.add_subplot(grid[:, 0]), data, true, backdrop)
    _draw_errors(figure.add_subplot(grid[0, 1]), data, errors)
    _draw_fixes(figure.add_subplot(grid[1, 1]), data)
    _draw_states(figure.add_subplot(grid[2, 1]), data)
    save(figure, out)


def save(figure: "Figure", out: Path) -> None:
    """Write a picture whole or not at all."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format=out.suffix.removeprefix("."))
    try:
        durable.write_whole(out, drawn.getvalue())
    except OSError as error:
        raise OutputError(
            f"{out}: cannot be written: {error.strerror}; name another place"
        ) from error


def _draw_path(
    axes: "Axes", data: RunData, true: GroundTruth | None, backdrop: Backdrop | None
) -> None:
    """The path from above; the odometry alone where nothing was found on a map."""
    on_map = len(data.poses.t_ns) > 0
    paths = [data.poses] if on_map else [path for path in data.odometry if len(path.t_ns)]
    view = _view_from_above(np.concatenate([path.T for path in paths] or [np.eye(4)[None]]))
    if backdrop is not None and on_map:
        places = _surroundings(view, data.poses, backdrop)
        axes.plot(*places.T, ".", color=MAP_POINT, ms=1.8, alpha=0.5, mew=0, rasterized=True)
        cameras = view.flat(backdrop.keyframes[:, :3, 3])
        axes.plot(*cameras.T, ".", color=MAP_KEYFRAME, ms=4, label="map keyframes")
    if true is not None and on_map:
        played = (true.t_ns >= data.t_ns.min()) & (true.t_ns <= data.t_ns.max())
        places = view.flat(true.T_world_cam[played, :3, 3])
        axes.plot(*places.T, color=TRUTH, lw=0.9, ls=(0, (4, 3)), label="truth")
    for number, path in enumerate(paths):
        name = "published poses" if on_map else f"odometry {number + 1}"
        colour = PATH if on_map else f"C{number}"
        _draw_with_gaps(axes, view, path, colour, name)
    if on_map:
        accepted = [fix["T_map_cam"] for fix in data.fixes if fix["accepted"]]
        places = view.flat(np.array(accepted).reshape(-1, 4, 4)[:, :3, 3])
        axes.plot(*places.T, "o", mfc="none", mec=GOOD, mew=0.9, ms=5, label="accepted fixes")
    axes.set_aspect("equal", adjustable="datalim")
    unit = "odometry units"
    if on_map:
        unit = "m" if backdrop is None or backdrop.metric else "units of the map"
    across, upward = _axis_names(view)
    axes.set_xlabel(f"{across} [{unit}], seen from above")
    axes.set_ylabel(f"{upward} [{unit}]")
    _finish(axes)
    if paths:
        axes.legend(loc="best", fontsize=8, frameon=True, framealpha=0.85, edgecolor="none")


def _draw_with_gaps(axes: "Axes", view: View, path: Poses, colour: str, name: str) -> None:
    """A line that is broken where frames lack a pose, and a mark at its begin."""
    places = view.flat(path.T[:, :3, 3])
    steps = np.diff(path.t_ns)
    usual = np.median(steps) if len(steps) else 0
    broken = np.flatnonzero(steps > 3 * usual) + 1
    line = np.insert(places, broken, np.nan, axis=0)
    axes.plot(*line.T, color=colour, lw=1.8, label=name)
    begin = "where it begins"
    named = begin in axes.get_legend_handles_labels()[1]
    axes.plot(*places[0], "o", color=colour, ms=6, mec=PAPER, label=None if named else begin)


def _surroundings(view: View, poses: Poses, backdrop: Backdrop) -> F64:
    """Map points (n, 2) on the paper, without the few far ones that would shrink the rest."""
    places = view.flat(backdrop.points)
    inner = np.percentile(places, (3, 97), axis=0)
    cameras = view.flat(np.concatenate((poses.T, backdrop.keyframes))[:, :3, 3])
    shown = np.vstack((inner, cameras))
    inside = (places >= shown.min(axis=0)) & (places <= shown.max(axis=0))
    near: F64 = places[inside.all(axis=1)]
    return near


def _draw_errors(axes: "Axes", data: RunData, errors: Errors | None) -> None:
    """Position error, if the truth is known, beside what the run itself believed."""
    time_s = _seconds(data, data.t_ns)
    order = np.argsort(time_s)
    axes.fill_between(
        time_s[order],
        0.0,
        300.0 * data.sigma_m[order],
        color=PATH,
        alpha=0.15,
        lw=0,
        label="3 published sigmas",
    )
    if errors is not None and len(errors.t_ns):
        centimetres = 100.0 * errors.position_m
        axes.plot(_seconds(data, errors.t_ns), centimetres, ".", color=PATH, ms=3, label="error")
        axes.set_ylim(0.0, 1.15 * max(float(np.percentile(centimetres, 99.5)), 0.5))
    axes.set_ylabel("position [cm]")
    _finish(axes, data)
    if np.isfinite(data.sigma_m).any():
        axes.legend(loc="upper left", fontsize=8, frameon=False, ncols=2)
    else:
        axes.text(0.5, 0.5, "no map pose", transform=axes.transAxes, color=FAINT, ha="center")


def _draw_fixes(axes: "Axes", data: RunData) -> None:
    """Inliers of each attempt to find a frame in the map."""
    for accepted, colour, name in ((False, BAD, "rejected"), (True, GOOD, "accepted")):
        chosen = [fix for fix in data.fixes if fix["accepted"] == accepted]
        times = _seconds(data, np.array([fix["t_ns"] for fix in chosen], np.int64))
        inliers = [fix["inliers"] for fix in chosen]
        axes.plot(times, inliers, "." if accepted else "x", color=colour, ms=5, label=name)
    axes.set_ylabel("inliers of a fix")
    _finish(axes, data)
    if data.fixes:
        axes.set_ylim(0.0, 1.2 * max(fix["inliers"] for fix in data.fixes) + 1.0)
        axes.legend(loc="upper left", fontsize=8, frameon=False, ncols=2)
    else:
        axes.text(0.5, 0.5, "no fix tried", transform=axes.transAxes, color=FAINT, ha="center")


def _draw_states(axes: "Axes", data: RunData) -> None:
    """A strip of states; frames with a map pose stand out."""
    time_s = _seconds(data, data.t_ns)
    width = float(np.median(np.abs(np.diff(time_s)))) if len(time_s) > 1 else 1.0
    published = np.isfinite(data.sigma_m)
    for state, colour in STATE_COLOURS.items():
        chosen = published if state == "on the map" else np.array(data.states) == state
        if chosen.any():
            axes.bar(time_s[chosen], 1.0, width=1.05 * width, color=colour, label=state, lw=0)
    axes.set_ylim(0.0, 1.0)
    axes.set_yticks([])
    axes.set_xlabel("time in the recording [s]")
    _finish(axes, data)
    axes.grid(visible=False)
    if len(data.t_ns):
        axes.legend(
            loc="upper center", bbox_to_anchor=(0.5, -0.75), fontsize=8, frameon=False, ncols=5
        )


def _finish(axes: "Axes", data: RunData | None = None) -> None:
    axes.grid(color="#eaeef2", lw=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=INK, labelsize=8, length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)
    if data is not None and len(data.t_ns):
        time_s = _seconds(data, data.t_ns)
        axes.set_xlim(float(time_s.min()), float(time_s.max()) + 1e-3)


def _title(data: RunData, errors: Errors | None) -> str:
    frames = max(len(data.t_ns), 1)
    parts = [
        data.name,
        f"{len(data.t_ns)} frames",
        f"{len(data.poses.t_ns) / frames:.0%} with a map pose",
    ]
    if errors is not None and len(errors.t_ns):
        middle, most = np.percentile(errors.position_m, (50, 95)) * 100.0
        degrees = np.median(errors.rotation_deg)
        parts.append(f"error median {middle:.1f} cm, {degrees:.2f}°, p95 {most:.1f} cm")
    return "  ·  ".join(parts)


def _seconds(data: RunData, t_ns: np.ndarray) -> F64:
    """Seconds since the earliest frame."""
    return np.asarray((t_ns - data.t_ns.min(initial=np.iinfo(np.int64).max)) * 1e-9)


def _view_from_above(T: F64) -> View:
    """Down is where the cameras (n, 4, 4) point down on average; a map axis if near to one."""
    down = T[:, :3, 1].mean(axis=0)
    axis = np.eye(3)[np.argmax(np.abs(down))] * np.sign(down[np.argmax(np.abs(down))])
    level = down @ axis > MAX_TILT_COS * np.linalg.norm(down)
    if level or np.linalg.norm(down) < 1e-6:
        down = axis
    down = down / np.linalg.norm(down)
    # The map's x axis runs to the right, or its y axis where x points up or down.
    right = max(np.eye(3)[:2], key=lambda e: float(np.linalg.norm(e - (e @ down) * down)))
    right = right - (right @ down) * down
    right = right / np.linalg.norm(right)
    return View(right, np.cross(right, down))


def _axis_names(view: View) -> tuple[str, str]:
    """What to write along the paper's two sides: map axes where they are such."""
    names = []
    for direction in view:
        i = int(np.argmax(np.abs(direction)))
        exact = abs(direction[i]) > 1.0 - 1e-9
        names.append(("" if direction[i] > 0 else "-") + "xyz"[i] if exact else "level")
    return names[0], names[1]


def _backdrop(map_: Map) -> Backdrop:
    step = max(1, map_.n_points // MAX_DRAWN_POINTS)
    indices = np.arange(0, map_.n_points, step, dtype=np.int32)
    return Backdrop(map_.points(indices).xyz, np.array(map_.T_map_cam), map_.manifest.metric)
