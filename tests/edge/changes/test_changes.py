# SPDX-License-Identifier: Apache-2.0
"""A painted wall as a map, with balls before it that a model of exact masks sees."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.changes.changes import Changes
from edge.changes.known import known_objects
from edge.changes.seen_points import seen_points
from edge.config.changes import ChangesConfig
from edge.tiles.labels import MapObject, read_labels
from edge.tiles.reader import NO_POINT, Map, open_map
from edge.types import ChangeEvent, Detections, Look
from maps.content import load, write
from maps.labels.layer import Seen
from tests.edge.changes.scenes import ball_detection, joined
from tests.edge.changes.wall_map import CUP, N_VIEWS, NAMES, Ball, labels, make_labelled, shown
from tests.maps.small_map import edited_manifest
from tests.maps.wall_drive import CAMERA, poses

NEW: Ball = (2, np.array([0.1, -0.25, 1.4]), 0.09)
CONFIG = ChangesConfig()
NO_SURFACE = np.empty((0, 3))

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> Map:
    return make_labelled(tmp_path_factory.mktemp("changes"))


def look(index: int, balls: list[Ball], seen: Detections | None = None) -> Look:
    T = poses(N_VIEWS)[index % N_VIEWS]
    detections = ball_detection(balls, T, CAMERA) if seen is None else seen
    return Look(index, 100_000_000 * index, shown(T, balls), T, NO_SURFACE, detections)


def run(stage: Changes, looks: list[Look]) -> list[ChangeEvent]:
    return [event for one in looks for event in stage.step(one)]


def test_where_all_is_as_it_was_nothing_is_said(labelled: Map) -> None:
    stage = Changes(labelled, CAMERA, NAMES, CONFIG)

    assert run(stage, [look(i, [CUP]) for i in range(N_VIEWS)]) == []


def test_what_is_gone_is_told_once_and_where_it_was(labelled: Map) -> None:
    stage = Changes(labelled, CAMERA, NAMES, CONFIG)

    (event,) = run(stage, [look(i, []) for i in range(2 * N_VIEWS)])

    assert (event.kind, event.label) == ("removed", "cup")
    assert np.linalg.norm(event.center_map_m - CUP[1]) < 0.02
    assert event.n_views >= 3
    assert event.score > 0.9
    assert len(event.evidence) >= 3
    mask = event.evidence[0].mask
    assert mask is not None
    exact = ball_detection([CUP], event.evidence[0].T_map_cam, CAMERA).masks[0]
    assert abs(mask.left - exact.left) < 10
    assert mask.inside.sum() == pytest.approx(exact.inside.sum(), rel=0.4)


def test_what_has_two_masks_is_expected_under_either_and_told_once(
    labelled: Map, tmp_path: Path
) -> None:
    said = labels(labelled, [CUP, CUP])
    even = np.arange(N_VIEWS) % 2 == 0
    one, other = said.objects
    said = said._replace(objects=[replace(one, found=even), replace(other, found=~even)])
    write(load(labelled)._replace(extra={"labels": said}), labelled.manifest, tmp_path / "twice")
    stage = Changes(open_map(tmp_path / "twice"), CAMERA, NAMES, CONFIG)

    (event,) = run(stage, [look(i, []) for i in range(N_VIEWS)])

    assert event.n_views == CONFIG.presence.gone_viewpoints


def test_two_things_whose_spaces_overlap_are_two_where_each_had_a_mask(
    labelled: Map, tmp_path: Path
) -> None:
    """Space that masks carve from one side is too long along their lines of sight."""
    above: Ball = (0, CUP[1] - np.array([0.0, 0.15, 0.0]), 0.1)
    said = labels(labelled, [CUP, above])
    longer = np.array([1.0, 1.0, 2.5])
    long = [
        replace(thing, points=ball[1] + longer * (thing.points - ball[1]))
        for thing, ball in zip(said.objects, (CUP, above), strict=True)
    ]
    said = said._replace(objects=long)
    write(load(labelled)._replace(extra={"labels": said}), labelled.manifest, tmp_path / "long")
    stage = Changes(open_map(tmp_path / "long"), CAMERA, NAMES, CONFIG)

    events = run(stage, [look(i, []) for i in range(2 * N_VIEWS)])

    assert [event.kind for event in events] == ["removed", "removed"]


@pytest.mark.parametrize("had_one_of_its_own", [True, False])
@pytest.mark.parametrize("are_both_there", [True, False])
def test_of_two_things_that_had_one_mask_the_one_that_is_gone_is_told(
    labelled: Map, tmp_path: Path, are_both_there: bool, had_one_of_its_own: bool
) -> None:
    twin: Ball = (0, CUP[1] - np.array([0.21, 0.0, 0.0]), 0.1)
    said = labels(labelled, [CUP, twin])
    one, other = said.objects
    both = replace(one, points=np.concatenate((one.points, other.points)))
    views = [labelled.pose(k) for k in range(len(labelled.T_map_cam))]
    found = [joined(ball_detection([CUP, twin], T, CAMERA)) for T in views]
    seen = [Seen(d.boxes, d.classes, d.scores) for d in found]
    said = said._replace(objects=[both] + [other] * had_one_of_its_own, seen=seen)
    write(load(labelled)._replace(extra={"labels": said}), labelled.manifest, tmp_path / "both")
    stage = Changes(open_map(tmp_path / "both"), CAMERA, NAMES, CONFIG)
    looks = []
    for i in range(2 * N_VIEWS):
        T = poses(N_VIEWS)[i // 2].copy()
        T[1, 3] += 0.12 * (i % 2)  # from between, and beside
        balls = [CUP, twin] if are_both_there else [CUP]
        masks = joined(ball_detection(balls, T, CAMERA))
        looks.append(Look(i, 100_000_000 * i, shown(T, balls), T, NO_SURFACE, masks))

    events = run(stage, looks)

    assert [(event.kind, event.label) for event in events] == [("removed", "cup")] * (
        not are_both_there
    )
    for event in events:
        assert np.linalg.norm(event.center_map_m - twin[1]) < 0.03
        assert event.n_views >= 8
        assert event.score > 0.9
        mask = event.evidence[0].mask
        assert mask is not None
        exact = ball_detection([twin], event.evidence[0].T_map_cam, CAMERA).masks[0]
        assert mask.inside.sum() == pytest.approx(exact.inside.sum(), rel=0.4)


def test_a_piece_of_what_is_there_has_not_gone(labelled: Map, tmp_path: Path) -> None:
    piece: Ball = (0, CUP[1] + np.array([0.08, 0.0, 0.0]), 0.045)
    said = labels(labelled, [CUP, piece])
    write(load(labelled)._replace(extra={"labels": said}), labelled.manifest, tmp_path / "pieces")
    stage = Changes(open_map(tmp_path / "pieces"), CAMERA, NAMES, CONFIG)
    of_the_rest = (0, CUP[1] - np.array([0.035, 0.0, 0.0]), 0.075)

    assert run(stage, [look(i, [of_the_rest]) for i in range(2 * N_VIEWS)]) == []


def test_features_without_a_point_are_left_out(tmp_path: Path) -> None:
    make_labelled(tmp_path)
    folder = tmp_path / "labelled"
    (tile,) = (folder / "tiles").iterdir()
    points = open_map(folder).tiles[0]["features/point"]
    lacking = np.where(np.arange(len(points)) % 3 == 0, NO_POINT, points).astype(points.dtype)
    tile.write_bytes(tile.read_bytes().replace(points.tobytes(), lacking.tobytes()))
    with edited_manifest(folder) as table:
        table["tiles"][0]["sha256"] = hashlib.sha256(tile.read_bytes()).hexdigest()
    opened = open_map(folder)

    stage = Changes(opened, CAMERA, NAMES, CONFIG)
    events = run(stage, [look(i, [NEW]) for i in range(2 * N_VIEWS)])
    seen, xyz = seen_points(opened, 0)

    assert sorted(event.kind for event in events) == ["added", "removed"]
    whole = opened.features(0)
    assert (whole.point == NO_POINT).any()
    np.testing.assert_array_equal(seen.pixels, whole.pixels[whole.point != NO_POINT])
    np.testing.assert_array_equal(xyz, opened.points(seen.point).xyz)


@pytest.mark.parametrize("n_found", [2, N_VIEWS])
def test_what_is_rarely_found_has_the_points_in_its_space(labelled: Map, n_found: int) -> None:
    """On the painted wall, whose points no mask has ever held."""
    said = read_labels(labelled)
    assert said is not None
    _, xyz = seen_points(labelled, 0)
    center = xyz[np.linalg.norm(xyz - xyz.mean(axis=0), axis=1).argmin()]
    space = center + 0.1 * np.random.default_rng(3).uniform(-1.0, 1.0, (300, 3))
    cameras = labelled.T_map_cam[:, :3, 3]
    said.objects = [MapObject(0, space, cameras, np.arange(len(cameras)) < n_found)]

    (known,) = known_objects(labelled, said, CONFIG)

    is_rare = n_found < N_VIEWS
    assert (len(known.points) > 3) == is_rare
    off = np.abs(labelled.points(known.points).xyz - center)
    assert (off < 0.1 + 0.05).all()


@pytest.mark.parametrize("was_looked_at", [True, False])
def test_images_that_no_model_was_shown_do_not_say_that_a_place_was_free(
    labelled: Map, tmp_path: Path, was_looked_at: bool
) -> None:
    said = labels(labelled, [CUP])
    nothing = [
        seen._replace(boxes=seen.boxes[:0], classes=seen.classes[:0], scores=seen.scores[:0])
        for seen in said.seen
    ]
    votes = said.points._replace(seen=np.full_like(said.points.seen, was_looked_at))
    said = said._replace(points=votes, seen=nothing)
    write(load(labelled)._replace(extra={"labels": said}), labelled.manifest, tmp_path / "map")
    stage = Changes(open_map(tmp_path / "map"), CAMERA, NAMES, CONFIG)

    events = run(stage, [look(i, [CUP, NEW]) for i in range(N_VIEWS)])

    assert [event.kind for event in events] == ["added"] * was_looked_at


def test_a_camera_that_does_not_move_confirms_nothing(labelled: Map) -> None:
    stage = Changes(labelled, CAMERA, NAMES, CONFIG)
    still = [replace(look(3, [NEW]), index=i, t_ns=100_000_000 * i) for i in range(12)]

    assert run(stage, still) == []


def test_what_is_new_is_placed_by_its_views(labelled: Map) -> None:
    stage = Changes(labelled, CAMERA, NAMES, CONFIG)

    (event,) = run(stage, [look(i, [CUP, NEW]) for i in range(N_VIEWS)])

    assert (event.kind, event.label) == ("added", "book")
    assert np.linalg.norm(event.center_map_m - NEW[1]) < 0.05
    assert event.extent_m[0] == pytest.approx(2 * NEW[2], rel=0.5)


def test_what_is_new_beside_a_thing_of_its_kind_is_told_though_one_mask_holds_both(
    labelled: Map,
) -> None:
    stage = Changes(labelled, CAMERA, NAMES, CONFIG)
    twin: Ball = (0, CUP[1] - np.array([0.21, 0.0, 0.1]), 0.08)
    looks = []
    for one in (look(i, [CUP, twin]) for i in range(N_VIEWS)):
        assert one.detections is not None
        looks.append(replace(one, detections=joined(one.detections)))

    (event,) = run(stage, looks)

    assert (event.kind, event.label) == ("added", "cup")
    assert np.linalg.norm(event.center_map_m - twin[1]) < 0.05


@pytest.mark.parametrize("are_parted", [True, False])
def test_what_is_new_right_beside_one_of_its_kind_is_told_once_both_were_seen_apart(
    labelled: Map, tmp_path: Path, are_parted: bool
) -> None:
    """The space of the map's object is larger than it, as masks that carved it were from afar."""
    said = labels(labelled, [CUP])
    one = said.objects[0]
    said = said._replace(objects=[replace(one, points=one.center + 1.5 * (one.points - CUP[1]))])
    write(load(labelled)._replace(extra={"labels": said}), labelled.manifest, tmp_path / "map")
    stage = Changes(open_map(tmp_path / "map"), CAMERA, NAMES, CONFIG)
    beside: Ball = (0, CUP[1] - np.array([0.24, 0.0, 0.0]), 0.08)
    looks = [look(i, [CUP, beside] if are_parted else [beside]) for i in range(2 * N_VIEWS)]

    events = run(stage, looks)

    assert ("added" in {event.kind for event in events}) == are_parted


@pytest.mark.parametrize(("share", "is_told"), [(0.9, True), (0.45, False)])
def test_what_is_seen_from_near_alone_the_map_may_have_missed_from_afar(
    labelled: Map, share: float, is_told: bool
) -> None:
    stage = Changes(labelled, CAMERA, NAMES, CONFIG)
    speck: Ball = (2, NEW[1], 0.04)  # hides hardly a point
    looks = []
    for i in range(2 * N_VIEWS):
        T = poses(2 * N_VIEWS)[i].copy()
        T[:3, 3] = speck[1] + share * (T[:3, 3] - speck[1])
        found = ball_detection([CUP, speck], T, CAMERA)
        looks.append(Look(i, 100_000_000 * i, shown(T, [CUP, speck]), T, NO_SURFACE, found))

    assert [event.kind for event in run(stage, looks)] == ["added"] * is_told


@pytest.mark.parametrize("is_of_both", [True, False])
def test_what_stood_beside_one_of_its_kind_under_one_mask_is_nothing_new(
    labelled: Map, tmp_path: Path, is_of_both: bool
) -> None:
    """From some sides: from others something plain hid it, that the map knows nothing of."""
    beside: Ball = (0, CUP[1] - np.array([0.21, 0.0, 0.0]), 0.08)
    said = labels(labelled, [CUP])
    views = [labelled.pose(k) for k in range(len(labelled.T_map_cam))]
    found = [ball_detection([CUP, beside], T, CAMERA) for T in views]
    for i in range(0, len(views) * is_of_both, 2):
        both = joined(found[i])
        said.seen[i] = Seen(both.boxes, both.classes, both.scores)
    write(load(labelled)._replace(extra={"labels": said}), labelled.manifest, tmp_path / "map")
    stage = Changes(open_map(tmp_path / "map"), CAMERA, NAMES, CONFIG)

    events = run(stage, [look(i, [CUP, beside]) for i in range(2 * N_VIEWS)])

    assert [event.kind for event in events] == ["added"] * (not is_of_both)


def test_masks_over_what_the_map_knows_are_nothing_new(labelled: Map) -> None:
    # The model sees a book where the image shows the wall as it was: it did not see it before.
    stage = Changes(labelled, CAMERA, NAMES, CONFIG)
    on_wall: Ball = (2, np.array([0.1, -0.25, 1.95]), 0.15)
    looks = []
    for i in range(N_VIEWS):
        one = look(i, [CUP])
        looks.append(replace(one, detections=ball_detection([CUP, on_wall], one.T_map_cam, CAMERA)))

    assert run(stage, looks) == []


def test_patches_here_and_there_under_one_mask_are_nothing_new(labelled: Map) -> None:
    stage = Changes(labelled, CAMERA, NAMES, CONFIG)
    looks = []
    for i in range(N_VIEWS):
        one = look(i, [CUP, NEW])
        assert one.detections is not None
        cup, new = one.detections.masks
        h, w = new.inside.shape
        corners = np.ones((h, w), bool)
        corners[h // 4 : -(h // 4)] = corners[:, w // 4 : -(w // 4)] = False
        masks = (cup, new._replace(inside=corners))
        looks.append(replace(one, detections=replace(one.detections, masks=masks)))

    assert run(stage, looks) == []


def test_people_come_and_go_unsaid_and_what_they_hide_is_not_missed(labelled: Map) -> None:
    stage = Changes(labelled, CAMERA, NAMES, CONFIG)
    person: Ball = (1, np.array([0.05, 0.05, 1.1]), 0.25)

    assert run(stage, [look(i, [person]) for i in range(N_VIEWS)]) == []


def test_only_movable_classes_are_told_where_some_are_named(labelled: Map) -> None:
    config = ChangesConfig(movable=("book",))

    events = run(Changes(labelled, CAMERA, NAMES, config), [look(i, [NEW]) for i in range(N_VIEWS)])

    assert [event.label for event in events] == ["book"]


def test_a_blinking_model_does_not_take_a_thing_away(labelled: Map) -> None:
    rng = np.random.default_rng(5)
    for _ in range(2):
        stage = Changes(labelled, CAMERA, NAMES, CONFIG)
        looks = [
            replace(one, detections=ball_detection([], one.T_map_cam, CAMERA))
            if rng.random() < 0.2
            else one
            for one in (look(i, [CUP]) for i in range(2 * N_VIEWS))
        ]

        assert run(stage, looks) == []
