# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from edge.errors import CameraLost
from tests.edge.cameras.device_tree import MadeTree


@pytest.fixture
def made(tmp_path: Path) -> MadeTree:
    return MadeTree(tmp_path)


def test_a_camera_is_found_by_its_socket(made: MadeTree) -> None:
    made.plug("1.2", 4, "A1")
    found = made.tree.find(str(made.socket("1.2")), "")
    assert found.node == str(made.dev / "video4")
    assert found.serial == "A1"
    assert found.by_path == made.socket("1.2").name
    assert found.key == "serial:A1"


def test_a_node_without_serial_is_known_by_its_socket(made: MadeTree) -> None:
    made.plug("1.2", 0)
    found = made.tree.find(str(made.dev / "video0"), "")
    assert found.key == f"path:{made.socket('1.2').name}"


def test_another_camera_in_the_socket_is_not_taken(made: MadeTree) -> None:
    made.plug("1.2", 0, "B2")
    with pytest.raises(CameraLost, match="serial B2 is in the place of A1"):
        made.tree.find(str(made.socket("1.2")), "A1")


@pytest.mark.parametrize("named", [True, False])
def test_with_its_serial_it_is_found_in_another_socket(made: MadeTree, named: bool) -> None:
    made.plug("1.2", 0, "B2")
    made.plug("1.3", 2, "A1")
    device = str(made.socket("1.2" if named else "1.9")) if named else ""
    assert made.tree.find(device, "A1").node == str(made.dev / "video2")


def test_without_a_serial_another_socket_is_not_searched(made: MadeTree) -> None:
    made.plug("1.3", 2, "A1")
    with pytest.raises(CameraLost, match="is not plugged in"):
        made.tree.find(str(made.socket("1.2")), "")


def test_two_cameras_of_one_serial_are_not_guessed_between(made: MadeTree) -> None:
    made.plug("1.2", 0, "0001")
    made.plug("1.3", 2, "0001")
    with pytest.raises(CameraLost, match="2 cameras have serial 0001"):
        made.tree.find("", "0001")
    assert made.tree.find(str(made.socket("1.3")), "0001").node == str(made.dev / "video2")


def test_each_camera_is_listed_once_by_its_first_node(made: MadeTree) -> None:
    made.plug("1.2", 0, "A1")
    made.plug("1.3", 2)
    second_name = made.socket("1.2").with_name("pci-usbv2-video-index0")
    second_name.symlink_to(made.dev / "video0")
    assert [entry.node for entry in made.tree.all()] == [
        str(made.dev / "video0"),
        str(made.dev / "video2"),
    ]
