# SPDX-License-Identifier: Apache-2.0
"""One run in a map as a picture: its way, its error with what it claims, its corrections."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tools.bench.localisation_runs import Played, corrections_m

TRUE, OURS, CLAIMED, SMOOTH = "#22272e", "#0969da", "#bf8700", "#1a7f37"


def draw(played: Played, path: Path) -> None:
    """Write the picture."""
    figure = Figure(figsize=(13, 4), layout="constrained")
    way, error, moved = figure.subplots(1, 3)
    _way(way, played)
    _error(error, played)
    _corrections(moved, played)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def _way(axes: Axes, played: Played) -> None:
    """From where the way is longest: along the axis in which it extends least."""
    true = np.array([T[:3, 3] for T in played.truth if T is not None])
    ours = np.array([r.pose.T_map_cam[:3, 3] for r in played.reports if r.pose is not None])
    everything = np.vstack([part for part in (true, ours) if len(part)])
    centre = everything.mean(axis=0)
    axis = np.linalg.svd(everything - centre, full_matrices=False)[2]
    for points, colour, name in ((true, TRUE, "truth"), (ours, OURS, "published")):
        if len(points):
            flat = (points - centre) @ axis[:2].T
            axes.plot(*flat.T, ".", color=colour, ms=2, label=name)
    axes.set(title="way [m]", aspect="equal")
    axes.legend()


def _error(axes: Axes, played: Played) -> None:
    t, off, sigma = [], [], []
    first_ns = played.reports[0].update.t_ns
    for report, T in zip(played.reports, played.truth, strict=True):
        if report.pose is None or T is None:
            continue
        t.append((report.update.t_ns - first_ns) * 1e-9)
        off.append(100.0 * float(np.linalg.norm(report.pose.T_map_cam[:3, 3] - T[:3, 3])))
        sigma.append(100.0 * float(np.sqrt(np.trace(report.pose.covariance[:3, :3]))))
    axes.plot(t, off, ".", color=OURS, ms=3, label="error")
    axes.plot(t, 3.0 * np.array(sigma), color=CLAIMED, lw=1, label="3 sigma claimed")
    axes.set(title="position [cm] over time [s]", yscale="log" if off else "linear")
    axes.legend()


def _corrections(axes: Axes, played: Played) -> None:
    bins = np.logspace(-2, 2, 33).tolist()
    for name, colour, stream in (
        ("exact", OURS, lambda pose: pose.T_map_cam),
        ("smooth", SMOOTH, lambda pose: pose.T_map_cam_smooth),
    ):
        cm = np.clip(100.0 * corrections_m(played.reports, stream), bins[0], bins[-1])
        axes.hist(cm, bins, histtype="step", color=colour, label=name)
    axes.set(title="corrections [cm] of a frame", xscale="log", yscale="symlog")
    axes.legend()
