# SPDX-License-Identifier: Apache-2.0
"""A changed room differs by what its list says, and by nothing else."""

import numpy as np
import pytest

from tests.tools.simworld.conftest import SMALL
from tools.simworld.changes import change_room, count_views
from tools.simworld.errors import WorldError
from tools.simworld.paths import make_path
from tools.simworld.renderer import Renderer, Tracer
from tools.simworld.rooms import make_room
from tools.simworld.world import World


def where(world: World) -> dict[int, bytes]:
    return {t.id: t.T_world_thing.tobytes() for t in world.things}


@pytest.mark.parametrize("seed", range(5))
def test_list_names_exactly_the_things_that_differ(seed: int) -> None:
    before = make_room(1)
    after, changes = change_room(before, seed, added=3, removed=4, moved=2)
    a, b = where(before), where(after)
    assert {c.id for c in changes if c.kind == "removed"} == {i for i in a if b.get(i) != a[i]}
    assert {c.id for c in changes if c.kind == "added"} == {i for i in b if a.get(i) != b[i]}
    assert {c.id for c in changes if c.moved} == {i for i in a if i in b and a[i] != b[i]}
    assert len(changes) == 3 + 4 + 2 * 2
    for change in changes:
        world = before if change.kind == "removed" else after
        thing = next(t for t in world.things if t.id == change.id)
        low, high = thing.bounds()
        assert change.center == pytest.approx(0.5 * (low + high), abs=1e-5)
        assert change.size == pytest.approx(high - low, abs=1e-5)
        assert change.label == thing.label


@pytest.mark.parametrize("seed", range(5))
def test_added_things_touch_nothing_but_what_they_stand_on(seed: int) -> None:
    after, changes = change_room(make_room(1), seed)
    for change in changes:
        if change.kind == "removed":
            continue
        new = next(t for t in after.things if t.id == change.id)
        base = next(t for t in after.things if t.id == new.base_id)
        low, high = new.bounds()
        assert low[2] == pytest.approx(base.bounds()[1][2] if base.label else 0.0, abs=0.15)
        for other in after.things[1:]:
            if other.id in (new.id, base.id):
                continue
            other_low, other_high = other.bounds()
            assert (low > other_high).any() or (other_low > high).any()


def test_views_differ_only_where_changed_things_are(office: Renderer) -> None:
    after, changes = change_room(office.world, 3)
    T = make_path(office.world, 3, 10.0).T_world_cam[::40]
    tracers = Tracer(office.world, SMALL), Tracer(after, SMALL)
    ids = {c.id for c in changes}
    for pose in T:
        a, b = (tracer.trace(pose) for tracer in tracers)
        differing = (a.ids != b.ids) | (a.depth_m != b.depth_m)
        assert set(np.unique(a.ids[differing])) | set(np.unique(b.ids[differing])) <= ids | set(
            np.unique(a.ids[differing & np.isin(b.ids, list(ids))])
        ) | set(np.unique(b.ids[differing & np.isin(a.ids, list(ids))]))


def test_views_are_counted_where_a_thing_shows(office: Renderer) -> None:
    after, changes = change_room(office.world, 3)
    T = make_path(office.world, 3, 10.0).T_world_cam[::20]
    counted = count_views(office.world, after, office.through(SMALL).camera, T, changes)
    assert any(c.views > 0 for c in counted)
    tracer = Tracer(after, SMALL)
    for change in counted:
        if change.kind == "added" and change.views:
            sizes = [(tracer.trace(pose).ids == change.id).sum() for pose in T]
            # counted on a quarter of the size
            assert change.median_px == pytest.approx(
                np.median([s for s in sizes if s >= 100] or [100]), rel=0.35, abs=60
            )


def test_more_changes_than_things_are_refused() -> None:
    with pytest.raises(WorldError, match="can be taken away"):
        change_room(make_room(1), 1, removed=500)


def test_nothing_comes_to_where_something_was() -> None:
    before = make_room(2)
    _, changes = change_room(before, 4, added=4, removed=4, moved=2)
    gone = [c for c in changes if c.kind == "removed"]
    for new in (c for c in changes if c.kind == "added"):
        for old in gone:
            apart = np.abs(np.array(new.center) - old.center)
            assert (apart > 0.5 * (np.array(new.size) + old.size)).any()


def test_only_things_of_the_labels_come_and_go_in_the_sizes_asked_for() -> None:
    labels = ("ball", "mug")
    after, changes = change_room(make_room(1), 5, 3, 1, 0, labels, (1.5, 1.5))
    assert {c.label for c in changes} <= set(labels)
    plain, usual = change_room(make_room(1), 5, 3, 1, 0, labels)
    assert len(after.things) == len(plain.things)
    large = [max(c.size) for c in changes if c.kind == "added"]
    assert max(large) > max(max(c.size) for c in usual if c.kind == "added")
