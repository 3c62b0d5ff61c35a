# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.config.features import OrbConfig
from edge.errors import TileError
from edge.geometry import se3
from edge.tiles.reader import open_map, read_manifest
from maps.build import BuildInput, build
from maps.cli import main
from maps.content import load, write
from maps.merge import merge
from maps.settings import BuildSettings
from maps.thin import needed, thin
from maps.verification import verify
from tests.maps.small_map import write_small_map
from tests.maps.wall_drive import CAMERA, WALL_Z_M, write_wall_drive

SETTINGS = BuildSettings(lens="given", tile_m=0.3)


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two maps of one wall: of the even images and of the odd ones."""
    folder = tmp_path_factory.mktemp("maps")
    drive = write_wall_drive(folder / "wall", 8)
    for name, first in (("even", 0), ("odd", 1)):
        build(BuildInput([drive], slice(first, None), 2), folder / name, SETTINGS)
    return folder / "even", folder / "odd"


def test_two_maps_of_one_frame_join(halves: tuple[Path, Path], tmp_path: Path) -> None:
    manifest, overlap = merge(*halves, tmp_path / "both")
    verify(tmp_path / "both")
    assert overlap.places == overlap.agreeing == 4
    even, odd, both = (open_map(path) for path in (*halves, tmp_path / "both"))
    assert both.n_keyframes == even.n_keyframes + odd.n_keyframes == 8
    assert both.n_points == even.n_points + odd.n_points - overlap.points
    assert overlap.points > 0.2 * even.n_points  # ORB does not find every corner twice
    assert manifest.sequences == ["wall", "wall"]
    assert len(manifest.cameras) == 1
    assert manifest.build["tile_m"] == 0.3
    words = load(odd).descriptions[1].words
    best, _ = both.bow.query(words, 1)
    assert both.keyframe_source[best[0]].tolist() == [1, 3]


def test_points_of_both_maps_are_one_that_keyframes_of_both_see(
    halves: tuple[Path, Path], tmp_path: Path
) -> None:
    _, overlap = merge(*halves, tmp_path / "both")
    both = open_map(tmp_path / "both")
    points = both.points(np.arange(both.n_points, dtype=np.int32))
    shared, off_px, beyond = [], [], []
    for index in range(both.n_points):
        keyframes, rows = both.point_views(index)
        if len(set(both.keyframe_source[keyframes, 0].tolist())) == 1:
            continue
        shared.append(index)
        for k, row in zip(keyframes.tolist(), rows.tolist(), strict=True):
            local = se3.transform(se3.inverse(both.pose(k)), points.xyz[index : index + 1])
            features = both.features(k)
            off = np.linalg.norm(CAMERA.project(local)[0] - features.pixels[row])
            off_px.append(off / 1.2 ** features.octave[row])
            towards = both.pose(k)[:3, 3] - points.xyz[index]
            cosine = towards @ points.direction[index] / np.linalg.norm(towards)
            beyond.append(np.arccos(min(cosine, 1.0)) - points.half_angle_rad[index])
    assert len(shared) == overlap.points
    assert max(off_px) < 8.0
    assert max(beyond) < 0.05
    # Right to what their covariance says, and no surer for being of two maps.
    off = np.abs(points.xyz[shared, 2] - WALL_Z_M)
    assert np.median(off) < 0.015
    assert np.mean(off < 3.5 * np.sqrt(points.covariance[shared, 2, 2])) > 0.95
    neighbours, _ = both.covisible(0)
    assert set(both.keyframe_source[neighbours, 0].tolist()) == {0, 1}


def test_a_map_knows_no_more_for_being_joined_with_itself(
    halves: tuple[Path, Path], tmp_path: Path
) -> None:
    _, overlap = merge(halves[0], halves[0], tmp_path / "twice")
    verify(tmp_path / "twice")
    once, twice = (load(open_map(path)).points for path in (halves[0], tmp_path / "twice"))
    assert overlap.points > 0.9 * len(once.xyz)
    order = [int(np.argmin(np.abs(once.xyz - xyz).sum(axis=1))) for xyz in twice.xyz]
    for name in ("xyz", "lower", "parallax_rad", "direction", "half_angle_rad", "pixel_size"):
        there, here = getattr(once, name)[order], getattr(twice, name)
        np.testing.assert_allclose(here, there, rtol=2e-3, atol=2e-3 * np.abs(there).mean())
    assert np.count_nonzero(twice.n_views == 2 * once.n_views[order]) == overlap.points


def test_a_keyframe_that_the_other_map_stands_for_can_be_thinned_out(
    halves: tuple[Path, Path], tmp_path: Path
) -> None:
    merge(*halves, tmp_path / "both")
    alone = len(needed(load(open_map(halves[0])), 0.5, 2))
    together = len(needed(load(open_map(tmp_path / "both")), 0.5, 2))
    assert together <= alone + 2 < 8


def test_maps_of_different_frames_are_refused(halves: tuple[Path, Path], tmp_path: Path) -> None:
    opened = open_map(halves[1])
    content = load(opened)
    T = se3.exp((0.4, 0.1, 0.0, 0.0, 0.3, 0.0))
    moved = content._replace(
        views=[view._replace(T_map_cam=T @ view.T_map_cam) for view in content.views],
        points=content.points._replace(xyz=se3.transform(T, content.points.xyz)),
    )
    write(moved, opened.manifest, tmp_path / "moved")
    with pytest.raises(TileError, match=r"moved: is not in the frame of .*even"):
        merge(halves[0], tmp_path / "moved", tmp_path / "both")
    assert not (tmp_path / "both").exists()


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"metric": False}, "unit"),
        ({"frame": "hall"}, "frame"),
        ({"extractor": OrbConfig(levels=5)}, "extractor"),
    ],
)
def test_maps_whose_numbers_mean_other_things_are_refused(
    halves: tuple[Path, Path], tmp_path: Path, change: dict[str, object], what: str
) -> None:
    opened = open_map(halves[1])
    write(load(opened), msgspec.structs.replace(opened.manifest, **change), tmp_path / "other")
    with pytest.raises(TileError, match=f"another {what}"):
        merge(halves[0], tmp_path / "other", tmp_path / "both")


def test_thinning_drops_what_others_see_and_nothing_else(tmp_path: Path) -> None:
    drive = write_wall_drive(tmp_path / "wall", 9)
    build(BuildInput([drive]), tmp_path / "map", SETTINGS)
    content = load(open_map(tmp_path / "map"))
    kept = needed(content, 0.8, 2)
    assert 2 < len(kept) < 9
    assert {0, 8} <= set(kept)  # the ends see what nobody else does
    seen = {int(point) for k in kept for point in content.points.point[k]}
    for k in set(range(9)) - set(kept):
        assert np.mean([int(point) in seen for point in content.points.point[k]]) >= 0.8
    assert needed(content, 1.0, 9) == list(range(9))
    thin(tmp_path / "map", tmp_path / "thin", 0.8, 2)
    verify(tmp_path / "thin")
    assert open_map(tmp_path / "thin").keyframe_source[:, 1].tolist() == kept


def test_a_view_from_far_off_does_not_stand_for_one_from_near(tmp_path: Path) -> None:
    drive = write_wall_drive(tmp_path / "wall", 9)
    build(BuildInput([drive]), tmp_path / "map", SETTINGS)
    content = load(open_map(tmp_path / "map"))
    few = len(needed(content, 0.8, 2))
    back = np.diag((1.0, 1.0, 1.0, 1.0))
    views = []
    for number, view in enumerate(content.views):
        back[2, 3] = -1.5 if number % 2 else 0.0  # at 1.75 of the distance, the same angles
        views.append(view._replace(T_map_cam=back @ view.T_map_cam))
    assert len(needed(content._replace(views=views), 0.8, 2)) > few


def test_thinning_takes_the_place_of_an_earlier_map_and_of_its_signature(
    halves: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    opened = open_map(halves[0])
    write(load(opened), opened.manifest, tmp_path / "map")
    (tmp_path / "map" / "manifest.sig").write_bytes(bytes(64))
    command = ["thin", str(halves[0]), "--out", str(tmp_path / "map"), "--share", "0.5"]
    assert main([*command, "--others", "1"]) == 0
    said = capsys.readouterr().out
    assert "of 4 keyframes" in said
    assert "signature is void" in said
    assert not (tmp_path / "map" / "manifest.sig").exists()
    assert verify(tmp_path / "map").keyframes < 4
    assert main(["align", str(tmp_path / "map"), "--up", "-1,0,0"]) == 0
    assert read_manifest(tmp_path / "map").T_local_map is not None


@pytest.mark.parametrize("command", [["thin"], ["merge", "other"]])
@pytest.mark.parametrize("name", ["small", "link", "one/../small", "around"])
def test_a_map_is_not_written_over_what_it_is_made_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str], name: str
) -> None:
    small = write_small_map(tmp_path / "around" / "inner").folder
    (tmp_path / "around" / "manifest.json").write_text("{}")  # so that it passes for a map
    (tmp_path / "small").symlink_to(small)
    write_small_map(tmp_path / "other", seed=1)
    (tmp_path / "one").mkdir()
    (tmp_path / "link").symlink_to(small)
    before = {path: path.read_bytes() for path in small.rglob("*") if path.is_file()}
    maps = [str(small), *(str(tmp_path / each) for each in command[1:])]
    assert main([command[0], *maps, "--out", str(tmp_path / name)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "is or holds what is to be read" in said
    assert {path: path.read_bytes() for path in small.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("name", ["small/again", "small/tiles/again", "link/a/b"])
def test_a_map_is_not_written_into_a_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    small = write_small_map(tmp_path / "small").folder
    (tmp_path / "link").symlink_to(small)
    before = sorted(small.rglob("*"))
    assert main(["thin", str(small), "--out", str(tmp_path / name)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "would lie within the map" in said
    assert sorted(small.rglob("*")) == before


@pytest.mark.parametrize("command", [["thin"], ["merge", "other"]])
def test_damage_gets_no_new_hash(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: list[str],
) -> None:
    monkeypatch.setattr("edge.tiles.reader.CHECKED_AT_ONCE_BYTES", 0)
    small, other = write_small_map(tmp_path / "small").folder, tmp_path / "other"
    write_small_map(other, seed=1)
    tile = open_map(small).tiles[0].path
    data = bytearray(tile.read_bytes())
    data[-1] ^= 1
    tile.write_bytes(data)
    name, *more = command
    maps = [str(small), *(str(tmp_path / each) for each in more)]
    assert main([name, *maps, "--out", str(tmp_path / "out")]) == 2
    assert "is damaged" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
