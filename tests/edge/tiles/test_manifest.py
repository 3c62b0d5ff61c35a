# SPDX-License-Identifier: Apache-2.0
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.errors import BadMagic, TileError, UnsupportedVersion
from edge.tiles import manifest as manifest_format
from tests.maps.small_map import write_small_map
from tests.maps.wall_drive import CAMERA

ORIGIN = Path("some/manifest.json")
Tree = dict[str, Any]


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> str:
    small = write_small_map(tmp_path_factory.mktemp("maps") / "small")
    return (small.folder / "manifest.json").read_text()


def decode(tree: Tree) -> manifest_format.Manifest:
    unsealed = {key: value for key, value in tree.items() if key != "checksum"}
    return manifest_format.decode(json.dumps(unsealed).encode(), ORIGIN)


def test_any_other_digit_is_found_out(tree: str) -> None:
    digits = [i for i, letter in enumerate(tree) if letter.isdigit()]
    for i in np.random.default_rng(0).choice(digits, 200):
        spoilt = tree[:i] + str((int(tree[i]) + 1) % 10) + tree[i + 1 :]
        with pytest.raises(TileError, match=str(ORIGIN)):
            manifest_format.decode(spoilt.encode(), ORIGIN)


def test_a_manifest_of_an_earlier_build_has_no_checksum_and_is_read(tree: str) -> None:
    assert decode(json.loads(tree)) == manifest_format.decode(tree.encode(), ORIGIN)


def test_it_survives_a_round_trip(tree: str) -> None:
    manifest = manifest_format.decode(tree.encode(), ORIGIN)
    assert manifest_format.encode(manifest).decode() == tree
    assert manifest.cameras[0].model() == CAMERA


def test_a_cameras_id_tells_calibrations_apart() -> None:
    from dataclasses import replace

    first = manifest_format.camera_entry(CAMERA)
    assert first == manifest_format.camera_entry(CAMERA)
    assert first.id != manifest_format.camera_entry(replace(CAMERA, fx=261.0)).id


def test_unknown_fields_are_for_newer_readers(tree: str) -> None:
    changed = json.loads(tree)
    changed["weather"] = changed["tiles"][0]["weather"] = "fine"
    decode(changed)


def test_another_version_is_refused_before_anything_else(tree: str) -> None:
    with pytest.raises(UnsupportedVersion, match=r"version 2.*reads 1"):
        decode({"format": "mapvo map", "version": 2, "tiles": "elsewhere"})


@pytest.mark.parametrize("text", ["", "{", "[]", "7", '{"format": "geojson"}', "\x00", "[" * 9999])
def test_other_files_are_no_manifest(text: str) -> None:
    with pytest.raises(BadMagic, match=r"manifest\.json"):
        manifest_format.decode(text.encode(), ORIGIN)


def test_a_manifest_cut_anywhere_is_refused(tree: str) -> None:
    data = tree.rstrip().encode()
    for length in range(len(data)):
        with pytest.raises(TileError, match=r"manifest\.json"):
            manifest_format.decode(data[:length], ORIGIN)


def _set(*keys: str | int, value: object) -> Callable[[Tree], None]:
    def change(tree: Tree) -> None:
        place: Any = tree
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    "path",
    [
        "../tiles/a.tile",
        "tiles/../a.tile",
        "/etc/passwd",
        "tiles/a/b.tile",
        "tiles/.tile",
        "tiles/a.tile\n",
        "tiles/a.tile\0",
        "tiles\\a.tile",
        "a.tile",
        "tiles/" + "a" * 65 + ".tile",
        "tiles/ä.tile",
    ],
)
def test_a_path_out_of_the_folder_is_refused(tree: str, path: str) -> None:
    changed = json.loads(tree)
    changed["tiles"][0]["path"] = path
    with pytest.raises(TileError, match=r"manifest\.json"):
        decode(changed)


@pytest.mark.parametrize(
    "change",
    [
        _set("tiles", value=[]),
        _set("tiles", 0, "keyframes", value=-1),
        _set("tiles", 0, "keyframes", value=1 << 40),
        _set("tiles", 0, "points", value=10**30),
        _set("tiles", 0, "bytes", value=-5),
        _set("tiles", 0, "bytes", value=1 << 60),
        _set("tiles", 0, "sha256", value="0" * 63),
        _set("tiles", 0, "id", value=1),
        _set("tiles", 0, "id", value=1 << 20),
        _set("tiles", 0, "origin_m", value=[0.0, 1e300, 0.0]),
        _set("tiles", 0, "origin_m", value=[0.0, 0.0]),
        _set("counts", "keyframes", value=3),
        _set("counts", "points", value=3),
        _set("vocabulary", "id", value="x"),
        _set("vocabulary", "words", value=-1),
        _set("cameras", value=[]),
        _set("cameras", 0, "fx", value=0.0),
        _set("cameras", 0, "width", value=-640),
        _set("cameras", 0, "distortion_model", value="fish"),
        _set("extractor", "levels", value=1000),
        _set("extractor", "scale_factor", value=1.0),
        _set("extractor", "unheard_of", value=1),
        _set("T_local_map", value=[[1.0]]),
        _set("metric", value="yes"),
    ],
)
def test_impossible_values_are_refused(tree: str, change: Callable[[Tree], None]) -> None:
    changed = json.loads(tree)
    change(changed)
    with pytest.raises(TileError, match=r"manifest\.json"):
        decode(changed)


def test_two_tiles_of_one_name_are_refused(tree: str) -> None:
    changed = json.loads(tree)
    changed["tiles"][1]["path"] = changed["tiles"][0]["path"]
    with pytest.raises(TileError, match="one path"):
        decode(changed)
