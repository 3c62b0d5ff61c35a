# SPDX-License-Identifier: Apache-2.0
"""Finds the lines of a build: segments of all images, matched three views at a time, and fused."""

from functools import partial
from typing import NamedTuple

from edge.config.lines import ThreeViewConfig
from edge.lines.threeview import Posed, match
from edge.runtime.progress import progress
from edge.types import I32, Pinhole
from maps.lines.fusion import fuse, join_segments, trusted
from maps.lines.layer import LineLayer
from maps.lines.twins import without_twins
from maps.lines.views import choose_neighbours, posed_segments
from maps.points import StoredPoints
from maps.survey import Survey
from maps.views import ViewSet
from maps.work_folder import key_of


class MatchTask(NamedTuple):
    """A view and those that it is matched with."""

    first: Posed
    others: tuple[Posed, ...]
    depth_range: tuple[float, float]


class Matched(NamedTuple):
    """Segments of other views that show the same."""

    segment: I32  # (n, m) in each other view, -1 for none


def line_layer(chosen: ViewSet, points: StoredPoints, survey: Survey) -> LineLayer:
    """The lines that at least three views of a build agree on."""
    camera = chosen.cameras[0].pinhole
    views = posed_segments(chosen, survey, camera)
    neighbours = choose_neighbours(views, points)
    tasks = [
        MatchTask(view, tuple(views[k] for k in others), depths)
        for view, (others, depths) in zip(views, neighbours, strict=True)
    ]
    settings = (ThreeViewConfig(), camera)
    keys = [key_of("line matches", settings, *_arrays(task)) for task in tasks]
    run = partial(match_lines, camera)
    found = survey.work.map(survey.workers, run, tasks, keys, Matched)
    matched = [rows.segment for rows in progress(found, len(tasks), "lines")]
    tracks = join_segments(views, [others for others, _ in neighbours], matched)
    return trusted(without_twins(fuse(views, tracks, camera)), views, camera)


def match_lines(camera: Pinhole, task: MatchTask) -> Matched:
    """What the segments of a view are in others; runs wherever the work is done."""
    return Matched(match(task.first, task.others, camera, task.depth_range, ThreeViewConfig())[0])


def _arrays(task: MatchTask) -> list[object]:
    posed = (task.first, *task.others)
    return [
        task.depth_range,
        *(array for view in posed for array in (*view.drawn.segments, view.drawn.grey)),
        *(view.T_cam_lines for view in posed),
    ]
