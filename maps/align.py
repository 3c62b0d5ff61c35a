# SPDX-License-Identifier: Apache-2.0
"""Levels and places a map: the transform to a frame with z up, in its manifest."""

import logging
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.errors import ConfigError, OutputError, RecordingError, TileError
from edge.geometry import se3, so3
from edge.store import durable
from edge.tiles import manifest as manifest_format
from edge.tiles.reader import Map, read_manifest
from edge.types import F64, Mat4
from maps.markers import MarkerImage, pose_of, sightings_in, squares
from maps.surveyed import read_surveyed

log = logging.getLogger(__name__)

SIGNATURE_NAME = "manifest.sig"
_MIN_POINTS = 3
# Surveyed points that lie nearer to a line than this part of their length leave a turn open.
_MIN_WIDTH = 0.05
_MAX_MISFIT = 0.05  # of the points' extent: more is a wrong point or another frame
_ON_THEIR_HEADS = -0.5  # cosine to upwards, in the mean, of the way up in images


class Alignment(NamedTuple):
    """How a map is placed."""

    T_local_map: Mat4
    how: str  # what it stands on, in words


def by_up(up: F64) -> Alignment:
    """Turn the direction `up` (3,) of the map to z, by the smallest turn; the origin stays."""
    length = float(np.linalg.norm(up)) if np.abs(up).max() < 1e9 else np.inf
    if not 1e-9 < length < np.inf:
        raise ConfigError("--up: has no direction; give three numbers X,Y,Z that point upwards")
    unit = up / length
    axis = np.cross(unit, (0.0, 0.0, 1.0))
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        axis, sine = np.array([1.0, 0.0, 0.0]), 1.0  # upright or upside down: about x
    angle = np.arccos(np.clip(unit[2], -1.0, 1.0))
    T = se3.from_rotation_translation(so3.exp(axis / sine * angle), np.zeros(3))
    return Alignment(T, f"up is {words(unit)} of the map")


def by_points(opened: Map, path: Path) -> Alignment:
    """Fit the map to the surveyed points of a file, whose frame has z up."""
    if not opened.manifest.metric:
        raise TileError(
            f"{opened.folder}: is not in metres, so surveyed points cannot place it; build it "
            "with --scale"
        )
    surveyed, in_map = read_surveyed(path, opened)
    if len(surveyed) < _MIN_POINTS:
        raise ConfigError(f"{path}: {len(surveyed)} points are too few; give three or more")
    extent = np.linalg.svd(surveyed - surveyed.mean(axis=0), compute_uv=False)
    if not extent[1] > _MIN_WIDTH * extent[0]:
        raise ConfigError(f"{path}: the points lie on one line; add one that lies beside it")
    limit_m = _MAX_MISFIT * extent[0]
    T, off = _rigid(in_map, surveyed)
    if off.max() > limit_m:
        raise ConfigError(
            f"{path}: point {words(surveyed[np.argmax(off)])} is {off.max():.2f} m from its place "
            "in the map; correct it, or leave it out"
        )
    # A level survey fits with two axes swapped as well, upside down.
    _, off_swapped = _rigid(in_map, surveyed[:, (1, 0, 2)])
    upwards = float(-(T[2, :3] @ opened.T_map_cam[:, :3, 1].T).mean())
    if off_swapped.max() <= limit_m and upwards < _ON_THEIR_HEADS:
        log.warning(
            "%s: the map's images stand on their heads: if the camera did not, X and Y of the "
            "points are swapped; give X to the east and Y to the north, and a point that lies "
            "higher than the others",
            path,
        )
    rmse_cm = 100.0 * float(np.sqrt(np.mean(off**2)))
    return Alignment(T, f"{len(surveyed)} surveyed points, {rmse_cm:.1f} cm off (RMS)")


def by_marker(
    opened: Map, number: int, family: str, *, on_wall: bool, recordings: list[Path]
) -> Alignment:
    """Put the origin on a square marker that the map's images show.

    A marker on the floor gives all axes: x to the right on its print, y up on it, z out of it. On
    a wall z is up on the print, and y goes into the wall.
    """
    sources = recordings_of(opened, recordings)
    images = (
        MarkerImage(
            sources[sequence].image(index),
            opened.cameras[opened.keyframe_camera[k]],
            opened.pose(k),
        )
        for k, (sequence, index) in enumerate(opened.keyframe_source.tolist())
    )
    sightings = [seen for seen in sightings_in(images, family) if seen.number == number]
    found = dict(squares(sightings))
    if number not in found:
        raise RecordingError(
            f"--marker {number}: is not seen from two sides among the map's images (family "
            f"{family}, {len(sightings)} sightings); check --family, or map around it"
        )
    T_local_map = se3.inverse(pose_of(found[number], on_wall=on_wall))
    return Alignment(T_local_map, f"marker {number} in {len(sightings)} images")


def write_alignment(folder: Path, alignment: Alignment) -> bool:
    """Put the transform into the manifest, whole or not at all; whether a signature was dropped.

    The signature goes first: a crash in between leaves the old map, whole but not signed.
    """
    manifest = read_manifest(folder)
    new = msgspec.structs.replace(manifest, T_local_map=alignment.T_local_map.tolist())
    signature = folder / SIGNATURE_NAME
    signed = signature.exists()
    try:
        if signed:
            durable.remove(signature)
        durable.write_whole(folder / manifest_format.FILE_NAME, manifest_format.encode(new))
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror})") from None
    return signed


def recordings_of(opened: Map, given: list[Path]) -> list[Recording]:
    """The recordings of a map's sequences: those given, or those here or beside the map."""
    places = (Path.cwd(), opened.folder.absolute().parent)
    found = []
    for name in opened.manifest.sequences:
        paths = [path for path in given if path.absolute().name == name]
        paths += [place / name for place in places if not given and (place / name).exists()]
        refusal = ""
        for path in paths:
            try:
                found.append(open_recording(path))
                break
            except RecordingError as error:  # another folder of that name
                refusal = f" ({error})"
        else:
            raise RecordingError(
                f"{opened.folder}: the images of its sequence {name} are needed; say where they "
                f"are with --images{refusal}"
            )
    return found


def words(vector: F64) -> str:
    """A vector as text."""
    return "(" + ", ".join(f"{value:.3f}" for value in vector) + ")"


def _rigid(points: F64, targets: F64) -> tuple[Mat4, F64]:
    """Rigid transform that takes points (n, 3) nearest to their targets, and how near (n,).

    After Kabsch 1976.
    """
    centre, there = points.mean(axis=0), targets.mean(axis=0)
    U, _, Vt = np.linalg.svd((targets - there).T @ (points - centre))
    R = U @ np.diag((1.0, 1.0, np.sign(np.linalg.det(U @ Vt)))) @ Vt
    T = se3.from_rotation_translation(R, there - R @ centre)
    return T, np.linalg.norm(se3.transform(T, points) - targets, axis=1)
