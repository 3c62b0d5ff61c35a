# SPDX-License-Identifier: Apache-2.0
import pytest

from edge.cameras.binding import binding_of, check_binding
from edge.cameras.v4l2_identity import Identity
from edge.errors import CameraRefused

HERE = Identity("/dev/video0", "usb-1-video-index0", "A1")
THERE = Identity("/dev/video2", "usb-2-video-index0", "A1")
OTHER = Identity("/dev/video0", "usb-1-video-index0", "B2")
NAMELESS = Identity("/dev/video0", "usb-1-video-index0", "")


def test_a_binding_names_socket_and_serial() -> None:
    assert binding_of(HERE) == "path:usb-1-video-index0 serial:A1"
    assert binding_of(NAMELESS) == "path:usb-1-video-index0"
    assert binding_of(Identity("/dev/video3", "", "")) == "path:/dev/video3"


@pytest.mark.parametrize(
    ("bound", "found", "plugged"),
    [
        ("", OTHER, [OTHER]),  # it names no camera
        (binding_of(HERE), HERE, [HERE]),
        (binding_of(HERE), THERE, [THERE]),  # put into another socket
        (binding_of(HERE), HERE, [HERE, THERE]),  # twins: the socket decides
        ("serial:A1", THERE, [THERE, OTHER]),
        (binding_of(NAMELESS), NAMELESS, [NAMELESS]),
    ],
)
def test_the_own_camera_is_taken(bound: str, found: Identity, plugged: list[Identity]) -> None:
    check_binding(bound, found, plugged, "camera.toml")


@pytest.mark.parametrize(
    ("bound", "found", "plugged"),
    [
        (binding_of(HERE), OTHER, [OTHER]),
        (binding_of(HERE), NAMELESS, [NAMELESS]),
        (binding_of(HERE), THERE, [HERE, THERE]),
        (binding_of(NAMELESS), Identity("/dev/video0", "usb-9", ""), []),
        ("oak:1844 CAM_B", HERE, [HERE]),
    ],
)
def test_another_one_is_refused(bound: str, found: Identity, plugged: list[Identity]) -> None:
    with pytest.raises(CameraRefused, match=r"camera\.toml: identity: .*calibrate"):
        check_binding(bound, found, plugged, "camera.toml")
