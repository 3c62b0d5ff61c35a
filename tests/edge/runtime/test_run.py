# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from edge.config import Config
from edge.config.map import MapConfig
from edge.config.outputs import OutputsConfig
from edge.config.serial import SerialConfig
from edge.errors import TileError, UnsupportedVersion
from edge.geometry.camera import CameraModel
from edge.runtime.live import OpenedMap
from edge.runtime.run import start_map, start_stream
from edge.runtime.search import NoSearch
from edge.tiles.reader import open_map
from tests.maps.small_map import edited_manifest, write_small_map

CAMERA = CameraModel(320, 240, 280.0, 280.0, 159.5, 119.5)


def opener(folder: Path) -> OpenedMap:
    return OpenedMap(open_map(folder), NoSearch(), CAMERA)


def config_of(folder: Path) -> Config:
    serial = SerialConfig(device="/dev/ttyS1")
    return Config(map=MapConfig(folder=str(folder)), outputs=OutputsConfig(serial=serial))


def test_a_damaged_map_is_left_out_at_the_start_and_told(tmp_path: Path) -> None:
    small = write_small_map(tmp_path / "small")
    path = small.folder / open_map(small.folder).manifest.tiles[0].path
    data = bytearray(path.read_bytes())
    data[-100] ^= 4
    path.write_bytes(data)
    config = config_of(small.folder)
    opened, trouble = start_map(config, opener)
    assert opened is None
    assert trouble.startswith(f"going on without a map: {path} is damaged")
    stream = start_stream(config, opened, trouble)
    assert stream is not None  # MAVLink, which takes no poses without a map
    assert b"mapvo: going on without a map" in stream.tell(trouble)


def test_what_a_person_got_wrong_ends_the_start(tmp_path: Path) -> None:
    with pytest.raises(TileError, match="is no folder"):
        start_map(config_of(tmp_path / "nowhere"), opener)
    small = write_small_map(tmp_path / "small")
    with edited_manifest(small.folder) as table:
        table["version"] = 99
    with pytest.raises(UnsupportedVersion):
        start_map(config_of(small.folder), opener)
    assert start_map(Config(), opener) == (None, "")
