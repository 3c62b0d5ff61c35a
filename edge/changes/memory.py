# SPDX-License-Identifier: Apache-2.0
"""What images have said of points of the map, a viewpoint at a time."""

from typing import NamedTuple

import numpy as np

from edge.changes.proof import CONFIRMED, CONTRADICTED, OPEN, Proof
from edge.types import F64, I32, Bools

_MAX_POINTS = 20_000  # remembered; the longest unseen is forgotten
_MAX_VIEWPOINTS = 16  # of a point
_MIN_AGAINST = 2


class _Record:
    """One point: what was said of it from each viewpoint, and the last viewpoint."""

    __slots__ = ("distance_m", "origin", "said", "xyz")

    def __init__(self, xyz: F64) -> None:
        self.xyz = xyz
        self.origin: F64 | None = None
        self.distance_m = 0.0
        self.said: list[tuple[int, int]] = []  # number of the view, verdict

    def count(self, verdict: int) -> int:
        return sum(said == verdict for _, said in self.said)


class Remembered(NamedTuple):
    """Some points as far as they are known."""

    points: I32  # (n,) of the map
    xyz: F64  # (n, 3) [m]
    distance_m: F64  # (n,) from the last camera
    same: I32  # (n,) viewpoints that confirm it
    other: I32  # (n,) that contradict it


class PointMemory:
    """Remembers verdicts. Owned by one thread."""

    def __init__(self, viewpoint_share: float) -> None:
        """A viewpoint is another one so far from the last, as a share of the point's distance."""
        self._share = viewpoint_share
        self._records: dict[int, _Record] = {}
        self._doubted: set[int] = set()  # those of them that some view contradicts

    def add(self, number: int, origin: F64, proof: Proof) -> None:
        """Take what the view of that number says, of a camera at `origin` (3,)."""
        distance = np.linalg.norm(proof.xyz - origin, axis=1).tolist()
        for i, point in enumerate(proof.points.tolist()):
            record = self._records.pop(point, None) or _Record(proof.xyz[i])
            self._records[point] = record  # the last seen come last
            verdict = int(proof.verdict[i])
            self._say(record, number, origin, distance[i], verdict)
            if verdict == CONTRADICTED:
                self._doubted.add(point)
        while len(self._records) > _MAX_POINTS:
            oldest = next(iter(self._records))
            del self._records[oldest]
            self._doubted.discard(oldest)

    def _say(
        self, record: _Record, number: int, origin: F64, distance_m: float, verdict: int
    ) -> None:
        record.distance_m = distance_m
        is_new = record.origin is None or (
            float(np.linalg.norm(origin - record.origin)) >= self._share * distance_m
        )
        if is_new:
            record.origin = origin
            record.said = [*record.said[-_MAX_VIEWPOINTS + 1 :], (number, verdict)]
        elif verdict == CONFIRMED or record.said[-1][1] == OPEN:
            record.said[-1] = (number, verdict)  # of one viewpoint what confirms it counts

    def are_doubted(self, points: I32) -> Bools:
        """Which points (n,) some view contradicts."""
        doubted: Bools = np.isin(points, np.fromiter(self._doubted, np.int32, len(self._doubted)))
        return doubted

    def suspects(self) -> Remembered:
        """Points that at least two viewpoints contradict and hardly any confirms."""
        found = []
        for point in sorted(self._doubted):
            record = self._records[point]
            other = record.count(CONTRADICTED)
            if other >= _MIN_AGAINST and 4 * record.count(CONFIRMED) <= other:
                found.append(point)
        return self.of(np.array(found, np.int32))

    def of(self, points: I32) -> Remembered:
        """What is known of points; those never seen are left out."""
        known = [int(p) for p in points if int(p) in self._records]
        records = [self._records[p] for p in known]
        return Remembered(
            np.array(known, np.int32),
            np.array([record.xyz for record in records], np.float64).reshape(-1, 3),
            np.array([record.distance_m for record in records], np.float64),
            np.array([record.count(CONFIRMED) for record in records], np.int32),
            np.array([record.count(CONTRADICTED) for record in records], np.int32),
        )

    def said(self, points: I32) -> dict[int, tuple[int, int, int]]:
        """By the number of each view: how many of the points it confirms, leaves open, contradicts.

        Only views that count as viewpoints of a point.
        """
        counts: dict[int, list[int]] = {}
        for point in points.tolist():
            for number, verdict in self._records[point].said:
                counts.setdefault(number, [0, 0, 0])[CONFIRMED - verdict] += 1
        return {number: (c[0], c[1], c[2]) for number, c in counts.items()}
