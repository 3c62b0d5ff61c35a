# SPDX-License-Identifier: Apache-2.0
import hashlib
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.errors import TileError
from edge.tiles import format as tile_format
from edge.tiles import manifest as manifest_format
from edge.tiles.format import Array
from edge.tiles.labels import read_labels
from edge.tiles.manifest import LabelsEntry
from edge.tiles.reader import open_map
from maps.content import Content, join, load, select, write
from maps.labels.layer import LabelSet
from maps.verification import verify
from tests.maps.labels.made_up_labels import labels_for
from tests.maps.small_map import write_small_map


@pytest.fixture
def labelled(tmp_path: Path) -> tuple[Path, Content]:
    """A map in several tiles, with labels, and what it must hold."""
    made = write_small_map(tmp_path / "plain")
    opened = open_map(made.folder)
    content = load(opened)
    content = content._replace(extra={"labels": labels_for(content)})
    write(content, opened.manifest, tmp_path / "labelled")
    return tmp_path / "labelled", content


def test_labels_come_back_as_they_were_written(labelled: tuple[Path, Content]) -> None:
    folder, content = labelled
    verify(folder)
    opened = open_map(folder)
    assert len(opened.tiles) > 2
    again = load(opened)
    was, is_now = content.extra["labels"], again.extra["labels"]
    assert isinstance(was, LabelSet)
    assert isinstance(is_now, LabelSet)

    assert is_now.entry == was.entry
    for a, b in zip(was.seen, is_now.seen, strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)
    # Points may be numbered anew, but keep their place.
    order = np.lexsort(content.points.xyz.T), np.lexsort(again.points.xyz.T)
    for x, y in zip(was.points, is_now.points, strict=True):
        np.testing.assert_array_equal(x[order[0]], y[order[1]])
    for one, other in zip(was.objects, is_now.objects, strict=True):
        assert one.label == other.label
        np.testing.assert_allclose(one.points, other.points, atol=1e-6)
        np.testing.assert_allclose(one.cameras, other.cameras, atol=1e-6)
        np.testing.assert_array_equal(one.found, other.found)
        assert [p.view for p in one.portraits] == [p.view for p in other.portraits]
        for a_portrait, b_portrait in zip(one.portraits, other.portraits, strict=True):
            np.testing.assert_allclose(a_portrait.right, b_portrait.right, atol=1e-6)
            np.testing.assert_allclose(a_portrait.side_m, b_portrait.side_m, rtol=1e-6)
            np.testing.assert_array_equal(a_portrait.grey, b_portrait.grey)
    assert any(thing.portraits for thing in is_now.objects)


def test_thinning_takes_the_labels_along(labelled: tuple[Path, Content], tmp_path: Path) -> None:
    folder, content = labelled
    opened = open_map(folder)
    thinned = select(load(opened), [0, 2, 5])
    write(thinned, opened.manifest, tmp_path / "thin")
    verify(tmp_path / "thin")

    labels = read_labels(open_map(tmp_path / "thin"))

    assert labels is not None
    was = content.extra["labels"]
    assert isinstance(was, LabelSet)
    np.testing.assert_array_equal(labels.detections(1)[0], was.seen[2].boxes)
    assert len(labels.objects) == len(was.objects)
    assert len(labels.point_class) == len(thinned.points.xyz)


def test_joining_maps_joins_classes_by_name(labelled: tuple[Path, Content]) -> None:
    _, first = labelled
    second = first._replace(extra={"labels": labels_for(first, 1, ["book", "vase"])})

    both = join(first, second, 1, [0]).extra["labels"]

    assert isinstance(both, LabelSet)
    assert both.entry.names == ["cup", "chair", "book", "vase"]
    a, b = first.extra["labels"], second.extra["labels"]
    assert isinstance(a, LabelSet)
    assert isinstance(b, LabelSet)
    n = len(a.points.label)
    np.testing.assert_array_equal(both.points.label[:n], a.points.label)
    expected = np.array([2, 3, -1])[b.points.label]
    np.testing.assert_array_equal(both.points.label[n:], expected)
    joined = both.objects[len(a.objects) :]
    assert [t.label for t in joined] == [t.label + 2 for t in b.objects]
    assert [t.portraits for t in joined] == [t.portraits for t in b.objects]


def test_a_map_without_labels_joins_one_with(labelled: tuple[Path, Content]) -> None:
    _, first = labelled
    both = join(first._replace(extra={}), first, 1, [0]).extra["labels"]

    assert isinstance(both, LabelSet)
    n = len(first.points.xyz)
    assert (both.points.label[:n] == -1).all()
    assert len(both.seen) == 2 * len(first.views)
    assert all(len(one.scores) == 0 for one in both.seen[: len(first.views)])


@pytest.mark.parametrize("labelled_first", [True, False])
def test_what_no_model_was_shown_is_known_of_joined_maps(
    labelled: tuple[Path, Content], tmp_path: Path, labelled_first: bool
) -> None:
    folder, content = labelled
    manifest, plain = open_map(folder).manifest, content._replace(extra={})
    one, other = (content, plain) if labelled_first else (plain, content)
    sequences = [*manifest.sequences, *manifest.sequences]
    both = msgspec.structs.replace(manifest, sequences=sequences)
    write(join(one, other, len(manifest.sequences), [0]), both, tmp_path / "both")
    opened = open_map(tmp_path / "both")
    labels = read_labels(opened)
    assert labels is not None

    is_first = opened.keyframe_source[:, 0] < len(manifest.sequences)

    np.testing.assert_array_equal(labels.looked_at, is_first == labelled_first)


def test_labels_of_a_class_that_has_no_name_are_refused(
    labelled: tuple[Path, Content],
) -> None:
    folder, _ = labelled
    opened = open_map(folder)
    entry = LabelsEntry(model="m", sha256="0" * 64, names=["cup"])
    manifest = msgspec.structs.replace(opened.manifest, labels=entry)
    (folder / manifest_format.FILE_NAME).write_bytes(manifest_format.encode(manifest))

    with pytest.raises(TileError, match="labels/class is damaged"):
        read_labels(open_map(folder))


def _with_layers(folder: Path, change: Callable[[dict[str, Array]], None]) -> None:
    """The map with the layers of its tiles changed in place."""
    manifest, entries = open_map(folder).manifest, []
    for entry in manifest.tiles:
        path = folder / entry.path
        layers, metadata = tile_format.decode(memoryview(path.read_bytes()), str(path))
        changed = {name: array.copy() for name, array in layers.items()}
        change(changed)
        data = tile_format.encode(changed, metadata)
        path.write_bytes(data)
        digest = hashlib.sha256(data).hexdigest()
        entries.append(msgspec.structs.replace(entry, bytes=len(data), sha256=digest))
    changed_manifest = msgspec.structs.replace(manifest, tiles=entries)
    (folder / manifest_format.FILE_NAME).write_bytes(manifest_format.encode(changed_manifest))


def test_maps_without_portraits_can_be_read(labelled: tuple[Path, Content]) -> None:
    folder, content = labelled

    def leave_out(layers: dict[str, Array]) -> None:
        for name in [name for name in layers if name.startswith("portraits/")]:
            del layers[name]

    _with_layers(folder, leave_out)

    verify(folder)
    labels = read_labels(open_map(folder))
    assert labels is not None
    was = content.extra["labels"]
    assert isinstance(was, LabelSet)
    assert len(labels.objects) == len(was.objects)
    assert not any(thing.portraits for thing in labels.objects)


@pytest.mark.parametrize(
    ("layer", "value"), [("view", 2), ("side", 0.0), ("side", np.nan), ("right", 0.5)]
)
def test_impossible_portraits_are_refused(
    labelled: tuple[Path, Content], layer: str, value: float
) -> None:
    folder, _ = labelled

    def spoil(layers: dict[str, Array]) -> None:
        layers[f"portraits/{layer}"][:] = value

    _with_layers(folder, spoil)

    with pytest.raises(TileError, match="portraits is damaged"):
        read_labels(open_map(folder))
