# SPDX-License-Identifier: Apache-2.0
"""Measures one map in a process of its own: opening, retrieval, localisation, memory.

python -m tools.bench.maps_measure MAP QUERIES.npz: prints one JSON object. The queries are the
features of images of another run along the street, made elsewhere, so that this process holds
nothing that a device would not.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.relocalise.bow import shipped_vocabulary
from edge.relocalise.features import Features
from edge.relocalise.relocaliser import Relocaliser
from edge.tiles.index import BowVector
from edge.tiles.reader import open_map
from edge.types import F64, Frame, Query

OPENINGS, CANDIDATES = 5, 20
_WARM = 3  # queries before anything is measured


class Asked(NamedTuple):
    """One query and the truth."""

    T_map_cam: F64
    features: Features


def main() -> None:
    """Measure the map of the command line."""
    folder, asked = Path(sys.argv[1]), _read(Path(sys.argv[2]))
    vocabulary = shipped_vocabulary()
    _localise(folder, asked[:_WARM])  # compiles
    open_ms = [_cpu_ms(lambda: open_map(folder)) for _ in range(OPENINGS)]
    words = [vocabulary.describe(each.features.descriptors) for each in asked]
    retrieve_ms = _retrieve_ms(folder, words)
    base_mb = _resident_mb()
    result = {
        "open_ms": float(np.median(open_ms)),
        "retrieve_ms": float(np.median(retrieve_ms)),
        "base_mb": base_mb,
        **_localise(folder, asked),
    }
    print(json.dumps(result))


def _retrieve_ms(folder: Path, words: list[BowVector]) -> list[float]:
    index = open_map(folder).bow
    return [_cpu_ms(lambda each=each: index.query(each, CANDIDATES)) for each in words]


def _localise(folder: Path, asked: list[Asked]) -> dict[str, float | None]:
    opened = open_map(folder)
    camera = opened.cameras[0]
    relocaliser = Relocaliser(opened, camera, RelocaliseConfig())
    blank = np.zeros((camera.height, camera.width), np.uint8)
    spent_ms, resident, off = [], [], []
    for number, (T, features) in enumerate(asked):
        query = Query(Frame(number, number, blank))
        began = time.process_time()
        attempt = relocaliser.attempt(features, query)
        spent_ms.append(1e3 * (time.process_time() - began))
        resident.append(_resident_mb())
        if attempt.reason == "ok" and attempt.solution is not None:
            off.append(float(np.linalg.norm(attempt.solution.T_map_cam[:3, 3] - T[:3, 3])))
    return {
        "localise_ms": float(np.median(spent_ms)),
        "found": len(off),
        "off_cm": 100.0 * float(np.median(off)) if off else None,
        "half_mb": resident[len(resident) // 2],
        "resident_mb": max(resident),
    }


def _read(path: Path) -> list[Asked]:
    with np.load(path) as stored:
        layers = {name: stored[name] for name in stored.files}
    ends = np.cumsum(layers["counts"])[:-1]
    columns = [np.split(layers[name], ends) for name in Features._fields]
    rows = zip(layers["T_map_cam"], zip(*columns, strict=True), strict=True)
    return [Asked(T, Features(*arrays)) for T, arrays in rows]


def _cpu_ms(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return 1e3 * (time.process_time() - began)


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    main()
