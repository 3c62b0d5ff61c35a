# SPDX-License-Identifier: Apache-2.0
"""Without a model: a board before a wall has come, has gone, or is as it was."""

import numpy as np
import pytest

from edge.changes.mapped import Mapped
from edge.changes.unlabelled import UnlabelledChanges
from edge.config.changes import ChangesConfig, GeometryConfig
from edge.tiles.reader import Map
from edge.types import ChangeEvent, Look
from tests.edge.changes.board_scene import BOARD, N_LIVE, SIDE_M, look, make_map
from tests.maps.wall_drive import CAMERA, WALL_Z_M

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Map:
    return make_map(tmp_path_factory.mktemp("bare"), with_board=False)


@pytest.fixture(scope="module")
def boarded(tmp_path_factory: pytest.TempPathFactory) -> Map:
    return make_map(tmp_path_factory.mktemp("boarded"), with_board=True)


def told(map_: Map, looks: list[Look]) -> list[ChangeEvent]:
    few_images = GeometryConfig(seen_through=8)  # these maps are of twelve only
    stage = UnlabelledChanges(map_, CAMERA, ChangesConfig(geometry=few_images))
    return [event for one in looks for event in stage.step(one)]


def check(event: ChangeEvent, kind: str) -> None:
    assert (event.kind, event.label, event.source) == (kind, "unknown", "geometry")
    assert np.linalg.norm(event.center_map_m - BOARD) < 0.06
    assert np.all(event.extent_m[:2] < 1.1 * SIDE_M)
    assert np.all(event.extent_m[:2] > 0.25 * SIDE_M)
    assert event.score < 0.7
    assert event.n_views >= 3
    assert len(event.evidence) >= 3


def test_what_hides_the_wall_has_come(bare: Map) -> None:
    events = told(bare, [look(i, with_board=True) for i in range(2 * N_LIVE)])

    assert events
    for event in events:
        check(event, "added")


def test_what_the_wall_is_seen_through_has_gone(boarded: Map) -> None:
    events = told(boarded, [look(i, with_board=False) for i in range(2 * N_LIVE)])

    assert events
    for event in events:
        check(event, "removed")


@pytest.mark.parametrize("light", [1.0, 0.6])
def test_nothing_is_said_where_all_is_as_it_was(bare: Map, boarded: Map, light: float) -> None:
    for map_, with_board in ((bare, False), (boarded, True)):
        looks = [look(i, with_board=with_board, light=light) for i in range(N_LIVE)]

        assert told(map_, looks) == []


def test_without_depths_nothing_has_come(bare: Map) -> None:
    looks = [look(i, with_board=True, with_depth=False) for i in range(N_LIVE)]

    assert told(bare, looks) == []


def test_one_viewpoint_is_not_enough(bare: Map, boarded: Map) -> None:
    for map_, with_board in ((bare, True), (boarded, False)):
        assert told(map_, [look(0, with_board=with_board)] * 12) == []


def test_a_map_knows_its_wall_and_the_free_space_before_it(bare: Map) -> None:
    mapped = Mapped(bare, GeometryConfig())
    assert mapped.move_to(np.zeros(3))
    assert not mapped.move_to(np.full(3, 0.01))
    places = np.array([[0.1, 0.05, WALL_Z_M], [*BOARD]])
    towards = np.zeros((2, 3, 3))
    towards[:, 0] = (0.0, 0.0, -1.0)

    behind, there = mapped.seen_through(places, towards)

    assert mapped.distance(places)[0] < 0.1
    assert mapped.distance(places)[1] == pytest.approx(WALL_Z_M - BOARD[2], abs=0.05)
    assert there[0] >= 10
    assert (behind[1] >= 10, there[1]) == (True, 0)


def test_space_seen_through_from_the_front_may_hold_what_is_thin_from_there(bare: Map) -> None:
    mapped = Mapped(bare, GeometryConfig())
    mapped.move_to(np.zeros(3))
    from_aside = np.array([[[1.0, 0.0, 0.0]]])

    behind, _ = mapped.seen_through(BOARD[None], from_aside)

    assert behind[0] == 0
