# SPDX-License-Identifier: Apache-2.0
"""Surveyed points and where they are in a map, from a text file.

One line each, of either form; X Y Z [m] are in the surveyed frame, z up:

    X Y Z  at  x y z            x y z in the map frame
    X Y Z  in  IMAGE u v        seen at the pixel u v of an image of the map, by its index; a
                                point needs two such lines or more, from sides well apart
"""

from pathlib import Path

import numpy as np

from edge.errors import ConfigError
from edge.tiles.manifest import is_length
from edge.tiles.reader import Map
from edge.types import F64

_MIN_PARALLAX_RAD = np.deg2rad(2.0)
_MAX_MISS_PX = 8.0  # of the rays of one point
_FORMS = "give 'X Y Z at x y z' or 'X Y Z in IMAGE u v'"


def read_surveyed(path: Path, opened: Map) -> tuple[F64, F64]:
    """Surveyed points (n, 3), and the same points (n, 3) in the map."""
    surveyed: list[F64] = []
    in_map: list[F64] = []
    rays: dict[tuple[float, ...], list[tuple[F64, F64, float]]] = {}
    for number, line in enumerate(_lines(path), 1):
        cells = line.partition("#")[0].split()
        if not cells:
            continue
        where = f"{path}, line {number}"
        point, kind, place = _parse(cells, where)
        if kind == "at":
            surveyed.append(point)
            in_map.append(place)
        else:
            rays.setdefault(tuple(point), []).append(_ray(opened, place, where))
    for key, seen in rays.items():
        surveyed.append(np.array(key))
        in_map.append(_meeting(seen, f"{path}: point {' '.join(map(str, key))}"))
    return np.array(surveyed).reshape(-1, 3), np.array(in_map).reshape(-1, 3)


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}; give a text file") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is no UTF-8 text; give a text file") from None


def _parse(cells: list[str], where: str) -> tuple[F64, str, F64]:
    if len(cells) != 7 or cells[3] not in ("at", "in"):
        raise ConfigError(f"{where}: is no surveyed point; {_FORMS}")
    try:
        numbers = np.array([float(cell) for cell in (*cells[:3], *cells[4:])])
    except ValueError:
        raise ConfigError(f"{where}: holds something that is no number; {_FORMS}") from None
    if not all(is_length(number) for number in numbers):
        raise ConfigError(f"{where}: holds a number that is no possible length")
    return numbers[:3], cells[3], numbers[3:]


def _ray(opened: Map, place: F64, where: str) -> tuple[F64, F64, float]:
    """Centre, unit direction and focal length of a pixel of one of the map's images."""
    rows = np.flatnonzero(opened.keyframe_source[:, 1] == place[0])
    if len(rows) == 0:
        raise ConfigError(f"{where}: image {place[0]:g} is no keyframe of the map")
    if len(set(opened.keyframe_source[rows, 0].tolist())) > 1:
        raise ConfigError(
            f"{where}: several sequences have an image {place[0]:g}; give its place with 'at'"
        )
    camera = opened.cameras[int(opened.keyframe_camera[rows[0]])]
    ideal = camera.undistort(camera.normalise(place[None, 1:]))[0]
    if not np.isfinite(ideal).all():
        raise ConfigError(f"{where}: the lens sees nothing at that pixel")
    T = opened.pose(int(rows[0]))
    direction = T[:3, :3] @ (*ideal, 1.0)
    return T[:3, 3], direction / np.linalg.norm(direction), camera.fx


def _meeting(seen: list[tuple[F64, F64, float]], where: str) -> F64:
    """The point nearest to all rays; ConfigError where they do not meet."""
    centres, directions = (np.array([ray[i] for ray in seen]) for i in (0, 1))
    cosine = np.clip(directions @ directions.T, -1.0, 1.0)
    if np.arccos(cosine.min()) < _MIN_PARALLAX_RAD:
        raise ConfigError(f"{where}: is seen from one side only; add an image from further aside")
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    point = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))
    towards = point - centres
    distance = np.linalg.norm(towards, axis=1)
    miss = np.linalg.norm(np.einsum("nij,nj->ni", across, towards), axis=1)
    worst = float(np.max(miss / distance * [ray[2] for ray in seen]))
    if np.any(np.einsum("ni,ni->n", directions, towards) < 0.0) or worst > _MAX_MISS_PX:
        raise ConfigError(f"{where}: its pixels miss each other by {worst:.0f} px; correct one")
    return np.asarray(point)
