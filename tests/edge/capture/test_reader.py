# SPDX-License-Identifier: Apache-2.0
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.records import Chunk
from mcap.writer import Writer

from edge.capture import format as format_
from edge.capture.chunks import unpack
from edge.capture.reader import CaptureFile, StoredImage
from edge.errors import RecordingError
from tests.edge.capture.captures import PERIOD_NS, header, write


def test_rows_come_back_in_the_order_of_time(tmp_path: Path) -> None:
    capture = CaptureFile(write(tmp_path / "a.mcap", 15))
    rows = list(capture.rows(format_.STATE))
    assert rows == [(n * PERIOD_NS, b'{"n": %d}' % n) for n in range(15)]
    assert capture.header == header()


def test_a_file_of_another_program_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(RecordingError, match=r"other\.mcap: was not recorded by mapvo"):
        CaptureFile(path)


def _read_all(path: Path) -> None:
    capture = CaptureFile(path)
    for place in capture.image_places:
        StoredImage(path, place.chunk, place.offset, 0).read_bytes()
    for _ in capture.rows(format_.STATE):
        pass


def test_flipped_bits_are_noticed_or_harmless(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.mcap", 12, images="raw").read_bytes()
    rng = np.random.default_rng(5)
    head_and_index = np.r_[0:700, len(whole) - 1500 : len(whole)]
    places = [*rng.choice(head_and_index, 120), *rng.integers(0, len(whole), 60)]
    for number, at in enumerate(map(int, places)):
        data = bytearray(whole)
        data[at] ^= 1 << int(rng.integers(8))
        path = tmp_path / f"{number}.mcap"
        path.write_bytes(data)
        try:
            _read_all(path)
        except RecordingError as error:
            assert str(error).startswith(str(path))  # noqa: PT017  # both ends are right
        path.unlink()


def test_a_chunk_that_claims_to_be_huge_is_not_unpacked() -> None:
    chunk = Chunk("zstd", b"", 0, 0, 0, 1 << 40)
    with pytest.raises(ValueError, match="too large"):
        unpack(chunk)
    packed = zstandard.compress(bytes(1 << 20))
    with pytest.raises(ValueError, match="size is wrong"):
        unpack(Chunk("zstd", packed, 0, 0, zlib.crc32(bytes(1000)), 1000))
