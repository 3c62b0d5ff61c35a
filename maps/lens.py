# SPDX-License-Identifier: Apache-2.0
"""The lens that a camera's own tracks tell, where its images have poses.

A calibration that is a little off never quite fits the poses along the borders of the images. The
lens is taken only where parts of the drive that it was not fitted to agree better with it, where
the difference is worth a change, and where the tracks hold it up to the corners of the image.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.errors import ConfigError
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.relocalise.features import Features
from edge.types import F64, DepthSamples, Mat4
from maps.describe import Description
from maps.fusion import Points
from maps.lens_fit import SIZE, Sightings, fit, lens_with
from maps.matching import MatchSide

# How many parameters are let free, one try after another: k1; with k2 and the focal length; with
# the centre.
_TRIES = (1, 3, 5)
_PARTS = 4  # of the drive, each held out in turn
_MIN_VIEWS = 8
_MIN_POINTS = 240
_MAX_POINTS = 3000  # more tell no more
_POINT_VIEWS = 3
_POINT_PARALLAX_RAD = np.deg2rad(1.5)
# The cost of the parts held out must fall by this share to let k1 free, and by that one for more:
# what bends little pays little. Images must change by so many pixels (RMS) to be worth it.
_MIN_GAIN = {1: 0.005, 3: 0.03, 5: 0.03}
_MIN_CHANGE_PX = 0.2
# Where fits to other parts of the drive put the borders of the image more apart than this part of
# the greatest change, the lens is not known there.
_MAX_SIGMA_SHARE = 0.33


class Lens(NamedTuple):
    """A refined camera, and what speaks for it."""

    camera: CameraModel
    free: int  # how many parameters were let free
    gain: float  # share of the held-out parts' robust cost that it took away
    change_px: float  # RMS over the image


def refined(sightings: Sightings, camera: CameraModel) -> Lens | None:
    """Lens that the sightings ask for; None where the given one is as good as any."""
    sightings = spread(sightings)
    if not enough(sightings):
        return None
    parts = parts_of(sightings)
    given = np.zeros(SIZE)
    costs = [fit(part, camera, given, 0).cost for part in parts]
    best: Lens | None = None
    for free in _TRIES:
        try:
            costs, lens = _tried(sightings, parts, camera, free, costs, best)
        except (ConfigError, np.linalg.LinAlgError):
            continue  # such a lens folds the image, or the tracks do not hold it
        best = lens or best
    return best


def refitted(sightings: Sightings, camera: CameraModel, lens: Lens) -> Lens:
    """The lens once more, from sightings that were matched with its help."""
    try:
        theta = fit(spread(sightings), camera, np.zeros(SIZE), lens.free).theta
        model = lens_with(camera, theta)
    except (ConfigError, np.linalg.LinAlgError):
        return lens
    return lens._replace(camera=model, change_px=rms(_moved(camera, model)))


def _tried(
    sightings: Sightings,
    parts: list[Sightings],
    camera: CameraModel,
    free: int,
    costs: list[float],
    best: Lens | None,
) -> tuple[list[float], Lens | None]:
    """Let `free` parameters free: the costs of the held-out parts and the lens, if it is better."""
    given = np.zeros(SIZE)
    whole = fit(sightings, camera, given, free)
    model = lens_with(camera, whole.theta)
    change = _moved(camera, model) - _moved(camera, camera if best is None else best.camera)
    # What was fitted gains more than what was held out: this much is quickly said.
    if _gain([whole.cost], costs) < _MIN_GAIN[free] or rms(change) < _MIN_CHANGE_PX:
        return costs, None
    new_costs, thetas = [], []
    for number, part in enumerate(parts):
        others = _joined([p for k, p in enumerate(parts) if k != number])
        thetas.append(fit(others, camera, given, free).theta)
        new_costs.append(fit(part, camera, thetas[-1], 0).cost)
    better = [new < old for new, old in zip(new_costs, costs, strict=True)]
    gain = _gain(new_costs, costs)
    if (
        better.count(True) < _PARTS - 1
        or gain < _MIN_GAIN[free]
        or not _known_everywhere(camera, model, thetas)
    ):
        return costs, None
    gain = gain if best is None else 1.0 - (1.0 - best.gain) * (1.0 - gain)
    return new_costs, Lens(model, free, gain, rms(_moved(camera, model)))


def _gain(new: list[float], old: list[float]) -> float:
    return 1.0 - sum(new) / max(sum(old), 1e-9)


def sightings_of(
    own: NDArray[np.bool_],
    camera: CameraModel,
    poses: list[Mat4],
    described: list[Description],
    sides: list[MatchSide],
    points: Points,
) -> Sightings:
    """Sightings of points that are seen well enough, by the `own` (v,) views, all of `camera`."""
    kept = own[points.view]
    owner = np.repeat(np.arange(len(points.xyz)), np.diff(points.offsets))[kept]
    view, feature = points.view[kept], points.feature[kept]
    raw, scale = np.empty((len(view), 2)), np.empty(len(view))
    for v in np.unique(view):
        rows = view == v
        pixels = described[v].features.pixels[feature[rows]]
        raw[rows] = camera.distort_pixels(pixels.astype(np.float64))
        scale[rows] = sides[v].sigma[feature[rows]]
    sigma = np.hypot(points.accuracy.pose_px, points.accuracy.corner_px * scale)
    counts = np.bincount(owner, minlength=len(points.xyz))
    offsets = np.concatenate(([0], np.cumsum(counts)))
    T_cam_map = np.array([se3.inverse(T) for T in poses])
    well = (counts >= _POINT_VIEWS) & (points.parallax_rad >= _POINT_PARALLAX_RAD)
    every = Sightings(offsets, view, raw, sigma, points.xyz, T_cam_map)
    return every.some(np.flatnonzero(well))


def described_through(
    description: Description, given: CameraModel, lens: CameraModel
) -> Description:
    """The description with the pixels of another lens; what that one does not map is left out."""
    found = description.features
    raw = given.distort_pixels(found.pixels.astype(np.float64))
    ideal = lens.undistort_pixels(raw).astype(np.float32)
    kept = np.flatnonzero(np.isfinite(ideal).all(axis=1))
    features = Features(
        np.ascontiguousarray(ideal[kept]),
        np.ascontiguousarray(found.descriptors[kept]),
        found.octave[kept],
        found.angle_rad[kept],
        found.raw_pixels[kept],
    )
    samples = description.samples
    raw = given.distort_pixels(samples.pixels.astype(np.float64))
    pixels = lens.undistort_pixels(raw).astype(np.float32)
    known = np.isfinite(pixels).all(axis=1)
    return description._replace(
        features=features,
        depth=description.depth[kept],
        depth_sigma=description.depth_sigma[kept],
        samples=DepthSamples(pixels[known], samples.inverse_depth[known], samples.sigma[known]),
    )


def spread(sightings: Sightings, most: int = _MAX_POINTS) -> Sightings:
    """At most so many points, evenly from the drive."""
    n = len(sightings.xyz)
    if n <= most:
        return sightings
    return sightings.some(np.linspace(0, n - 1, most).astype(np.int64))


def enough(sightings: Sightings) -> bool:
    """Whether points and views are enough to tell what a camera does to its images."""
    return len(sightings.xyz) >= _MIN_POINTS and len(np.unique(sightings.view)) >= _MIN_VIEWS


def parts_of(sightings: Sightings) -> list[Sightings]:
    """Parts of the drive, by the first view of each point."""
    first = sightings.view[sightings.offsets[:-1]]
    order = np.argsort(first, kind="stable")
    return [sightings.some(np.sort(part)) for part in np.array_split(order, _PARTS)]


def _joined(parts: list[Sightings]) -> Sightings:
    sizes = np.concatenate([np.diff(part.offsets) for part in parts])
    return Sightings(
        np.concatenate(([0], np.cumsum(sizes))),
        np.concatenate([part.view for part in parts]),
        np.concatenate([part.raw for part in parts]),
        np.concatenate([part.sigma for part in parts]),
        np.concatenate([part.xyz for part in parts]),
        parts[0].T_cam_map,
    )


def _grid(camera: CameraModel) -> F64:
    """Raw pixels (n, 2) all over the image."""
    u, v = np.meshgrid(
        np.linspace(0.0, camera.width - 1.0, 17), np.linspace(0.0, camera.height - 1.0, 13)
    )
    return np.stack((u.ravel(), v.ravel()), axis=1)


def _moved(given: CameraModel, lens: CameraModel) -> F64:
    """Where another lens puts the rays of the given one's image: (n, 2) away from there [px]."""
    rays = given.undistort(given.normalise(_grid(given)))
    rays = rays[np.isfinite(rays).all(axis=1)]
    through = [camera.denormalise(camera.distort(rays)) for camera in (given, lens)]
    return np.asarray(through[1] - through[0], np.float64)


def rms(shift: F64) -> float:
    """Length of shifts (n, 2), root mean square; those that are NaN do not count."""
    return float(np.sqrt(np.nanmean(np.sum(shift**2, axis=1))))


def _known_everywhere(given: CameraModel, lens: CameraModel, thetas: list[F64]) -> bool:
    """Whether fits that each left out a part of the drive agree all over the image."""
    moved = np.array([_moved(given, lens_with(given, theta)) for theta in thetas])
    off = moved - moved.mean(axis=0)
    # The jackknife: such fits share most of what they rest on.
    n = len(thetas)
    sigma = np.sqrt((n - 1) / n * np.sum(off**2, axis=(0, 2)))
    greatest = np.linalg.norm(_moved(given, lens), axis=1).max()
    return bool(np.isfinite(sigma).all() and sigma.max() <= _MAX_SIGMA_SHARE * greatest)
