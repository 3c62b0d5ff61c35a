# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.cameras import images
from edge.errors import RecordingError
from tests.edge.cameras.recordings import picture, write_image


def test_grey_of_a_colour_image_is_its_luma(tmp_path: Path) -> None:
    red = np.zeros((20, 30, 3), np.uint8)
    red[..., 2] = 200
    write_image(tmp_path / "red.png", red)

    assert images.read_grey(tmp_path / "red.png").shape == (20, 30)
    # Decoders round or cut off: 59 or 60.
    assert images.read_grey(tmp_path / "red.png") == pytest.approx(0.299 * 200, abs=1.0)
    assert images.read_rgb(tmp_path / "red.png")[3, 4].tolist() == [200, 0, 0]


def test_rgb_of_a_grey_image_repeats_it(tmp_path: Path) -> None:
    write_image(tmp_path / "grey.png", picture(3))

    assert np.array_equal(images.read_rgb(tmp_path / "grey.png")[..., 1], picture(3))


@pytest.mark.parametrize("orientation", [3, 6])
def test_how_the_camera_was_held_turns_no_image(tmp_path: Path, orientation: int) -> None:
    path = tmp_path / "held.jpg"
    write_image(path, picture(3))
    plain = images.read_grey(path)
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01" + bytes([0, orientation, 0, 0])
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01" + entry + bytes(4)
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    data = path.read_bytes()
    path.write_bytes(data[:2] + segment + data[2:])

    assert np.array_equal(images.read_grey(path), plain)
    assert np.array_equal(images.read_rgb(path)[..., 0], plain)


def test_depth_comes_in_metres_and_unknown_stays_zero(tmp_path: Path) -> None:
    raw = np.full((20, 30), 2500, np.uint16)
    raw[0] = 0
    write_image(tmp_path / "depth.png", raw)
    depth_m = images.read_depth(tmp_path / "depth.png", 0.001)

    assert depth_m.dtype == np.float32
    assert depth_m[1:] == pytest.approx(2.5)
    assert (depth_m[0] == 0).all()


def test_depth_in_eight_bits_is_refused(tmp_path: Path) -> None:
    write_image(tmp_path / "depth.png", picture(0))

    with pytest.raises(RecordingError, match="no 16-bit grey image"):
        images.read_depth(tmp_path / "depth.png", 0.001)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("kept", [0.05, 0.3, 0.6, 0.95, 0.999])
def test_an_image_cut_short_anywhere_is_refused(tmp_path: Path, suffix: str, kept: float) -> None:
    path = tmp_path / f"image{suffix}"
    noise = np.random.default_rng(0).integers(0, 255, (120, 160), dtype=np.uint8)
    write_image(path, noise)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])

    with pytest.raises(RecordingError, match="is cut short"):
        images.read_grey(path)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("padding", [b"", b"\x00" * 1000, b"note of the recorder"])
def test_bytes_after_the_end_do_no_harm(tmp_path: Path, suffix: str, padding: bytes) -> None:
    path = tmp_path / f"image{suffix}"
    write_image(path, picture(1))
    path.write_bytes(path.read_bytes() + padding)

    assert images.read_grey(path).shape == (48, 64)


def test_a_chunk_that_says_it_is_huge_is_not_believed(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    write_image(path, picture(0))
    data = bytearray(path.read_bytes())
    at = data.index(b"IDAT")
    data[at - 4 : at] = b"\xff\xff\xff\x81"
    path.write_bytes(data)

    with pytest.raises(RecordingError, match="is cut short"):
        images.read_grey(path)


def test_a_thumbnail_does_not_hide_that_the_image_is_cut_short(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    small = cv2.imencode(".jpg", picture(0, 16, 16))[1].tobytes()
    big = cv2.imencode(".jpg", picture(0))[1].tobytes()
    segment = b"\xff\xe1" + (len(small) + 2).to_bytes(2, "big") + small
    path.write_bytes(big[:2] + segment + big[2:])

    assert images.read_grey(path).shape == (48, 64)
    path.write_bytes((big[:2] + segment + big[2:])[:-200])
    with pytest.raises(RecordingError, match="is cut short"):
        images.read_grey(path)


@pytest.mark.parametrize(
    ("data", "word"), [(b"", "is empty"), (b"GIF? no, words", "no image that can be decoded")]
)
def test_what_is_no_image_is_refused(tmp_path: Path, data: bytes, word: str) -> None:
    path = tmp_path / "image.png"
    path.write_bytes(data)

    with pytest.raises(RecordingError, match=word):
        images.read_grey(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is missing"):
        images.read_grey(tmp_path / "none.png")
    with pytest.raises(RecordingError, match="cannot be read"):
        images.read_grey(tmp_path)
