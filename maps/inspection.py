# SPDX-License-Identifier: Apache-2.0
"""What a map holds, as a table and as a picture."""

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from edge.errors import OutputError
from edge.tiles.labels import read_labels
from edge.tiles.reader import Map, open_map
from edge.types import F64, I32, Bools

Shade = tuple[Bools, str | None, str | F64]  # which points, how they are called, their colours

_PERCENTILES = (5, 50, 95)
_MAX_POINTS_DRAWN = 60_000
_MAX_FRUSTA_DRAWN = 300
_MAX_LABELS_NAMED = 12  # in the picture: those of most points


def table(folder: Path) -> str:
    """Lines that say what the map in `folder` holds."""
    opened = open_map(folder)
    return "\n".join(
        f"{name:<14} {value}"
        for name, value in [*_identity(opened), *_content(opened), *_sizes(opened)]
    )


def _identity(opened: Map) -> Iterable[tuple[str, str]]:
    manifest = opened.manifest
    low, high = np.array(manifest.bounds_m.min), np.array(manifest.bounds_m.max)
    unit = "m" if manifest.metric else "units (not metric)"
    yield "map", str(opened.folder)
    yield "written by", f"{manifest.writer}, format {manifest.version}, OpenCV {manifest.opencv}"
    yield "from", ", ".join(manifest.sequences)
    yield "frame", f"{manifest.frame}{'' if manifest.T_local_map is None else ', levelled'}"
    yield "extent", " x ".join(f"{side:.1f}" for side in high - low) + f" {unit}"
    for camera in manifest.cameras:
        lens = f"{camera.width}x{camera.height}, f {camera.fx:.1f} {camera.fy:.1f} px"
        yield "camera", f"{lens}, {camera.distortion_model}, id {camera.id[:12]}"
    vocabulary = manifest.vocabulary
    yield "vocabulary", f"{vocabulary.words} words, id {vocabulary.id[:12]}"
    orb = manifest.extractor
    names = (f"{name}={getattr(orb, name)}" for name in orb.__struct_fields__)
    yield "extractor", " ".join(names)
    yield "build", " ".join(f"{name}={value}" for name, value in manifest.build.items())


def _content(opened: Map) -> Iterable[tuple[str, str]]:
    counts = opened.manifest.counts
    points = opened.points(np.arange(opened.n_points, dtype=np.int32))
    yield "tiles", str(len(opened.tiles))
    yield "keyframes", str(opened.n_keyframes)
    per_keyframe = counts.observations / max(opened.n_keyframes, 1)
    yield "points", f"{opened.n_points}, {per_keyframe:.0f} seen by a keyframe"
    if opened.n_points == 0:
        return
    sigma = np.sqrt(np.linalg.eigvalsh(points.covariance)[:, 2])
    yield "views", _spread(points.n_views.astype(np.float64), "{:.0f}")
    yield "parallax", _spread(np.rad2deg(points.parallax_rad, dtype=np.float64), "{:.2f} deg")
    yield "sigma", _spread(sigma, "{:.4f}")
    if opened.lines.count:
        seen = [len(opened.lines.seen_by(k)) for k in range(opened.n_keyframes)]
        yield "lines", f"{opened.lines.count}, {np.mean(seen):.0f} seen by a keyframe"
    learned = opened.manifest.learned
    if learned is not None:
        per_keyframe = learned.counts.observations / max(opened.n_keyframes, 1)
        made = f"{learned.model}, sha256 {learned.sha256[:12]}"
        yield "learned", f"{learned.counts.points} points, {per_keyframe:.0f} a keyframe, by {made}"
    labels = read_labels(opened)
    if labels is not None:
        share = float(np.mean(labels.point_class >= 0))
        yield "labels", f"{100 * share:.0f} % of the points, {len(labels.objects)} objects"


def _sizes(opened: Map) -> Iterable[tuple[str, str]]:
    by_layer: dict[str, int] = defaultdict(int)
    for tile in opened.tiles:
        for name, array in tile.layers.items():
            by_layer[name.partition("/")[0]] += array.nbytes
    if (learned := opened.manifest.learned) is not None:
        by_layer["learned"] = sum(entry.bytes for entry in learned.tiles) + learned.vocabulary.bytes
    total = sum(entry.bytes for entry in opened.manifest.files())
    n = max(opened.n_keyframes, 1)
    for name, size in sorted(by_layer.items(), key=lambda item: -item[1]):
        yield f"  {name}", f"{size / 1e6:8.3f} MB {size / n / 1e3:7.2f} kB a keyframe"
    yield "on disk", f"{total / 1e6:8.3f} MB {total / n / 1e3:7.2f} kB a keyframe"


def _spread(values: F64, form: str) -> str:
    shares = np.percentile(values, _PERCENTILES)
    return ", ".join(
        f"{name} {form.format(value)}"
        for name, value in zip(("5 %", "median", "95 %"), shares, strict=True)
    )


def draw(folder: Path, picture: Path) -> None:
    """Write a PNG of points, lines and camera frusta from above and from the side."""
    try:
        import matplotlib as mpl
    except ImportError:
        raise OutputError("--picture needs matplotlib; install mapvo[maps]") from None
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    opened = open_map(folder)
    rows = _points_to_draw(opened)
    found = opened.points(rows)
    placed = opened.manifest.T_local_map
    rotation = _level(_up(opened)) if placed is None else np.array(placed)[:3, :3]
    both = np.vstack((found.xyz, opened.T_map_cam[:, :3, 3]))
    extent = float(np.linalg.norm(np.ptp(np.percentile(both, (5, 95), 0), 0)))
    points, frusta = found.xyz @ rotation.T, _frusta(opened, extent) @ rotation.T
    lines = _line_ends(opened) @ rotation.T
    groups = _by_label(opened, rows)
    shades = groups or [(rows >= 0, None, np.log2(found.n_views))]
    figure, axes = plt.subplots(1, 2, figsize=(16, 8), layout="constrained")
    sides = ((0, 1, "from above"), (0, 2, "from the side"))
    for axis, (a, b, title) in zip(axes, sides, strict=True):
        for chosen, name, shade in shades:
            axis.scatter(
                points[chosen, a], points[chosen, b], s=1.0, c=shade, label=name, linewidths=0
            )
        axis.plot(lines[:, :, a].T, lines[:, :, b].T, color="black", linewidth=0.8)
        for frustum in frusta:
            axis.plot(frustum[:, a], frustum[:, b], color="crimson", linewidth=0.6)
        axis.set(aspect="equal", title=title)
        axis.set_xlabel("m" if opened.manifest.metric else "map units")
        axis.grid(visible=True, alpha=0.3)
    if groups:
        axes[0].legend(markerscale=8.0, fontsize="small")
    figure.suptitle(f"{folder.name}: {opened.n_keyframes} keyframes, {opened.n_points} points")
    try:
        figure.savefig(picture, dpi=100)
    except OSError as error:
        raise OutputError(
            f"{picture}: cannot be written: {error.strerror}; name another place"
        ) from None
    finally:
        plt.close(figure)


def _points_to_draw(opened: Map) -> I32:
    """Points (n,) that are known to a few percent."""
    step = max(1, opened.n_points // _MAX_POINTS_DRAWN)
    rows = np.arange(0, opened.n_points, step, dtype=np.int32)
    sigma = np.sqrt(np.linalg.eigvalsh(opened.points(rows).covariance)[:, 2])
    return rows[sigma <= np.percentile(sigma, 90)] if len(sigma) else rows


def _by_label(opened: Map, rows: I32) -> list[Shade]:
    """Which of the points `rows` each class has, its name and a colour; none without labels."""
    labels = read_labels(opened)
    if labels is None:
        return []
    classes = labels.point_class[rows]
    groups: list[Shade] = [(classes < 0, "no label", "lightgrey")]
    counts = np.bincount(classes[classes >= 0], minlength=len(labels.names))
    order = [int(i) for i in np.argsort(-counts, kind="stable") if counts[i]]
    for place, label in enumerate(order):
        named = place < _MAX_LABELS_NAMED
        name = labels.names[label] if named else "_" + labels.names[label]  # _: not in the legend
        groups.append((classes == label, name, f"C{place % 10}"))
    return groups


def _line_ends(opened: Map) -> F64:
    """First and last places (n, 2, 3) where the map's lines were seen."""
    found = opened.lines.take(np.arange(opened.lines.count, dtype=np.int32))
    away = found.span[:, :, None] * found.lines.direction[:, None]
    ends: F64 = found.lines.point[:, None] + away
    return ends


def _up(opened: Map) -> F64:
    """Which way is up (3,), if the cameras were held upright on the whole."""
    up = -opened.T_map_cam[:, :3, 1].mean(axis=0)
    return np.asarray(up / max(float(np.linalg.norm(up)), 1e-9))


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
