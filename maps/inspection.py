# SPDX-License-Identifier: Apache-2.0
"""What a map holds, as a table."""

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from edge.tiles.labels import read_labels
from edge.tiles.reader import Map, open_map
from edge.types import F64

_PERCENTILES = (5, 50, 95)


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
