# SPDX-License-Identifier: Apache-2.0
"""The rolling shutter of a build's images, and features as if all rows had been read at once.

Rows that are read one after another while the camera moves are shifted against each other. How
fast it moved, the poses tell; how long the reading took, is what makes views agree best on their
points. The poses are taken for those of the middle row: what a clock that is off would add is
left alone, since the poses of later images will err by the same.
"""

import numpy as np

from edge.cameras.groundtruth import GroundTruth
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.odometry.motion import Rates, rates
from edge.relocalise.lens import lateness, turned_rows
from edge.types import F32, F64, DepthSamples
from maps.describe import Description
from maps.lens import enough, parts_of, rms, spread
from maps.lens_fit import SIZE, Sightings, fit, in_camera

# Poses nearer than this to an image tell little of how it moved.
_LEAST_APART_NS = 15_000_000
_MAX_POINTS = 1000
# Readouts are tried so far and so densely; the fine steps follow the best of the coarse ones.
_COARSE_S, _COARSE_STEPS = 0.01, 5
_FINE_S = 0.003
# No camera takes longer; what asks for more errs otherwise.
_MOST_S = 0.045
# What it must gain of the robust cost, and how far it must move features (RMS).
_MIN_GAIN = 0.03
_MIN_CHANGE_PX = 0.2


def rates_at(truth: GroundTruth, t_ns: int) -> Rates | None:
    """How the camera moved at `t_ns`; None where no two poses around it tell."""
    last = len(truth.t_ns) - 1
    before = int(np.searchsorted(truth.t_ns, t_ns - _LEAST_APART_NS, side="right")) - 1
    after = int(np.searchsorted(truth.t_ns, t_ns + _LEAST_APART_NS))
    before, after = max(before, 0), min(after, last)
    interval_ns = int(truth.t_ns[after] - truth.t_ns[before])
    T = truth.T_world_cam
    found = rates(se3.inverse(T[after]) @ T[before], interval_ns)
    around = truth.t_ns[before] <= t_ns <= truth.t_ns[after]
    return found if around and (found.turning.any() or found.velocity.any()) else None


def flow(ideal: F64, depth: F64, moving: Rates) -> F64:
    """How fast ideal points (n, 2) at `depth` (n,) move in the image, (n, 2) [1/s]."""
    turning = turned_rows(ideal, moving.turning)
    v = moving.velocity
    return np.asarray(turning + (v[:2] - ideal * v[2]) / depth[:, None])


def readout_of(sightings: Sightings, moving: list[Rates | None], camera: CameraModel) -> float:
    """Time from the first row to the last [s] that the sightings of `camera` ask for.

    Below zero where images stand on their head; zero where rows seem to be read at once.
    moving  of each view that has sightings
    """
    sightings = spread(sightings, _MAX_POINTS)
    if not enough(sightings):
        return 0.0
    trial = _Trial(sightings, moving, camera)
    if trial.change_px(_COARSE_STEPS * _COARSE_S) < _MIN_CHANGE_PX:
        return 0.0  # whoever stands still tells nothing
    readout_s = _best(trial)
    possible = abs(readout_s) <= _MOST_S
    return readout_s if possible and trial.is_clearly_better(readout_s) else 0.0


def _best(trial: "_Trial") -> float:
    coarse = _COARSE_S * np.arange(-_COARSE_STEPS, _COARSE_STEPS + 1)
    middle = coarse[int(np.argmin([trial.cost(float(r)) for r in coarse]))]
    fine = middle + _FINE_S * np.arange(-2, 3)
    costs = [trial.cost(float(r)) for r in fine]
    k = min(max(int(np.argmin(costs)), 1), len(fine) - 2)
    below, here, above = costs[k - 1 : k + 2]
    curvature = below - 2.0 * here + above
    shift = 0.5 * (below - above) / curvature if curvature > 0.0 else 0.0
    return float(fine[k] + _FINE_S * np.clip(shift, -1.0, 1.0))


class _Trial:
    """Sightings as they would be if rows had been read in another time."""

    def __init__(
        self, sightings: Sightings, moving: list[Rates | None], camera: CameraModel
    ) -> None:
        self._sightings, self._camera = sightings, camera
        self._ideal = camera.undistort(camera.normalise(sightings.raw))
        self._flow = np.zeros_like(self._ideal)
        depth = in_camera(sightings, sightings.xyz)[:, 2]
        for view in np.unique(sightings.view):
            rows, here = sightings.view == view, moving[view]
            if here is not None:
                self._flow[rows] = flow(self._ideal[rows], depth[rows], here)
        self._flow[~np.isfinite(self._flow).all(axis=1)] = 0.0

    def _moved(self, readout_s: float) -> Sightings:
        delay = readout_s * lateness(self._sightings.raw, self._camera)
        bent = self._camera.distort(self._ideal - delay[:, None] * self._flow)
        return self._sightings._replace(raw=self._camera.denormalise(bent))

    def _cost(self, sightings: Sightings) -> float:
        return fit(sightings, self._camera, np.zeros(SIZE), 0).cost

    def cost(self, readout_s: float) -> float:
        """Robust cost of the best points."""
        return self._cost(self._moved(readout_s))

    def change_px(self, readout_s: float) -> float:
        """How far features move, RMS."""
        shift = self._moved(readout_s).raw - self._moved(0.0).raw
        return rms(shift)

    def is_clearly_better(self, readout_s: float) -> bool:
        """Whether every part of the drive agrees better with it, and it is worth a change."""
        if self.change_px(readout_s) < _MIN_CHANGE_PX:
            return False
        new = [self._cost(part) for part in parts_of(self._moved(readout_s))]
        old = [self._cost(part) for part in parts_of(self._moved(0.0))]
        every = all(a < b for a, b in zip(new, old, strict=True))
        return every and sum(new) < (1.0 - _MIN_GAIN) * sum(old)


def at_once(
    description: Description, camera: CameraModel, moving: Rates, readout_s: float, depth: F64
) -> Description:
    """The description as if all rows had been read with the middle one.

    depth  (n,) of its features, none of them zero
    """

    def moved(pixels: F32, raw: F32, depth: F64) -> F32:
        delay = readout_s * lateness(raw.astype(np.float64), camera)
        shift = flow(camera.normalise(pixels.astype(np.float64)), depth, moving)
        return np.asarray(pixels - delay[:, None] * shift * (camera.fx, camera.fy), np.float32)

    found, samples = description.features, description.samples
    raw = camera.distort_pixels(samples.pixels.astype(np.float64)).astype(np.float32)
    far = 1.0 / np.maximum(samples.inverse_depth.astype(np.float64), 1e-6)
    return description._replace(
        features=found._replace(pixels=moved(found.pixels, found.raw_pixels, depth)),
        samples=DepthSamples(moved(samples.pixels, raw, far), samples.inverse_depth, samples.sigma),
    )
