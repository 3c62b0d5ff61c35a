# SPDX-License-Identifier: Apache-2.0
"""A picture of a change shows now, the map from there, both close up, and the map from above."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.geometry import se3
from edge.outputs.run_folder import RunFolder
from edge.runtime.change_pictures import ChangePictures
from edge.runtime.map_plan import COLOURS, MapPlan
from edge.runtime.map_view import MapView
from edge.tiles.labels import MapObject
from edge.tiles.reader import Map, open_map
from edge.types import U8, ChangeEvent, Evidence, Mask
from maps.content import load, write
from maps.labels.portraits import portray
from tests.edge.changes.board_scene import BOARD, SIDE_M, image, make_map
from tests.maps.labels.made_up_labels import labels_for
from tests.maps.wall_drive import CAMERA, poses

T_MAP_CAM = poses(8)[4]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def boarded(tmp_path_factory: pytest.TempPathFactory) -> Map:
    return make_map(tmp_path_factory.mktemp("pictures"), with_board=True)


def gone(t_ns: int) -> ChangeEvent:
    """The board's, of a view at 1 s."""
    view = Evidence(7, 1_000_000_000, T_MAP_CAM, Mask(140, 90, np.ones((60, 60), dtype=bool)))
    extent, seen = np.full(3, SIDE_M), image(T_MAP_CAM, with_board=False)
    return ChangeEvent(
        3, t_ns, "removed", "board", 0.9, BOARD, extent, 4, -4.0, "geometry", (view,), image=seen
    )


def has(picture: U8, colour: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture.astype(int) - colour).max(axis=2) < 60).any())


def test_a_change_is_outlined_now_and_in_the_map_and_marked_from_above(
    boarded: Map, tmp_path: Path
) -> None:
    with RunFolder(tmp_path / "run", CAMERA) as folder:
        pictures = ChangePictures(folder, boarded, CAMERA)
        pictures.add(gone(1_000_000_000))
        pictures.finish()
        folder.finish([], {})

    picture = np.asarray(cv2.imread(str(tmp_path / "run" / "change-003.png")), np.uint8)
    width = (picture.shape[1] - picture.shape[0] + 26) // 2  # of a panel: the plan is a square
    half = picture.shape[0] // 2
    for rows in (slice(26, half), slice(half + 26, None)):
        now, before = picture[rows, :width], picture[rows, width : 2 * width]
        assert has(now, COLOURS["removed"])
        assert has(before, COLOURS["removed"])
        assert np.ptp(before, axis=2).max() > 100  # points by distance, in colours
    assert has(picture[26:, 2 * width :], COLOURS["removed"])
    assert (tmp_path / "run" / "changes.png").exists()


def test_a_view_that_is_not_of_the_image_is_not_drawn_into_it(boarded: Map, tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run", CAMERA) as folder:
        ChangePictures(folder, boarded, CAMERA).add(gone(2_000_000_000))
        folder.finish([], {})

    picture = cv2.imread(str(tmp_path / "run" / "change-003.png"))
    assert picture is not None
    assert picture.shape[0] == picture.shape[1] + 26  # the plan alone


def test_the_plan_marks_a_change_at_its_place(boarded: Map) -> None:
    plan = MapPlan(boarded, 400)

    marked = (plan.draw([gone(1)]).astype(int) - plan.draw([])).any(axis=2)

    rows, columns = np.nonzero(marked)
    at = plan.pixel(BOARD)
    assert columns.min() <= at[0] <= columns.max()
    assert rows.min() <= at[1] <= rows.max()
    assert marked.mean() < 0.2


def test_words_of_changes_at_one_place_lie_below_one_another(boarded: Map) -> None:
    plan = MapPlan(boarded, 400)
    first = dataclasses.replace(gone(1), extent_m=np.zeros(3))
    second = dataclasses.replace(first, id=4)
    added = plan.draw([first]).astype(int) - plan.draw([first, second])
    column, row = plan.pixel(BOARD)
    rows, _ = np.nonzero(added[:, column + 10 :].any(axis=2))  # right of the rings
    assert rows.min() > row - 8


def test_the_map_shows_what_has_gone_as_it_was(boarded: Map, tmp_path: Path) -> None:
    seen_from = poses(8)
    axis = np.linspace(-0.5 * SIDE_M, 0.5 * SIDE_M, 5)
    x, y = np.meshgrid(axis, axis)
    space = BOARD + np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    cameras = np.stack([T[:3, 3] for T in seen_from])
    board = MapObject(0, space, cameras, np.ones(len(cameras), bool))
    things = portray(
        [board], seen_from, [CAMERA] * 8, lambda k: image(seen_from[k], with_board=True)
    )
    content = load(boarded)
    labels = labels_for(content)._replace(objects=things)
    write(content._replace(extra={"labels": labels}), boarded.manifest, tmp_path / "labelled")
    T = poses(8)[3]
    T[:3, 3] += (0.05, -0.03, 0.02)
    box = BOARD, np.full(3, SIDE_M)

    views = (MapView(map_, CAMERA) for map_ in (open_map(tmp_path / "labelled"), boarded))
    drawn, plain = (view.draw(T, image(T, with_board=False), box) for view in views)

    (at,) = CAMERA.project(se3.transform(se3.inverse(T), BOARD[None])).astype(int)
    part = slice(at[1] - 20, at[1] + 21), slice(at[0] - 20, at[0] + 21)
    was = cv2.GaussianBlur(image(T, with_board=True), (0, 0), 2.0)[part][..., None].astype(int)
    # Medians: some points have rings, and the portrait is coarse.
    assert np.median(np.abs(drawn[part] - was)) < 10.0
    assert np.median(np.abs(plain[part] - was)) > 40.0
