# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.cameras.recording import open_recording
from edge.errors import RecordingError
from tests.edge.cameras.recordings import CAMERA_TOML, picture, write_image, write_tum


@pytest.mark.parametrize("below", ["images", "."])
def test_photos_are_in_the_order_of_their_names(tmp_path: Path, below: str) -> None:
    (tmp_path / "camera.toml").write_text(CAMERA_TOML)
    for i, name in enumerate(["a.png", "b.JPG", "c.png"]):
        write_image(tmp_path / below / name, picture(i))
    (tmp_path / below / "notes.txt").write_text("no photo")
    recording = open_recording(tmp_path)
    assert recording.t_ns.tolist() == [0, 10**9, 2 * 10**9]
    assert (recording.camera.fx, recording.groundtruth) == (50.0, None)
    image = recording.image(2)
    assert image is not None
    np.testing.assert_array_equal(image, picture(2))


def test_a_sequence_without_its_list_is_not_taken_for_photos(tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / "rgb.txt").unlink()
    with pytest.raises(RecordingError, match=r"rgb\.txt"):
        open_recording(tmp_path)


def test_a_calibration_that_is_none_is_named(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", picture(0))
    (tmp_path / "camera.toml").write_text("width = 3")
    with pytest.raises(RecordingError, match=r"camera\.toml"):
        open_recording(tmp_path)
