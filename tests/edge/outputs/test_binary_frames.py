# SPDX-License-Identifier: Apache-2.0
import binascii
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from edge.config import serial as budget
from edge.outputs import binary_frames
from edge.outputs.binary_frames import BinaryFrames, cobs_encode, frame
from edge.outputs.frames import BodyPose
from edge.outputs.serial_stream import LinkStatus
from edge.types import OdometryState
from tests.edge.outputs.frame_decoder import cobs_decode, unframe


# The examples of the paper's and the encyclopaedia's tables (Cheshire and Baker 1999).
@pytest.mark.parametrize(
    ("plain", "coded"),
    [
        ("", "01"),
        ("00", "01 01"),
        ("00 00", "01 01 01"),
        ("00 11 00", "01 02 11 01"),
        ("11 22 00 33", "03 11 22 02 33"),
        ("11 22 33 44", "05 11 22 33 44"),
        ("11 00 00 00", "02 11 01 01 01"),
    ],
)
def test_cobs_is_as_published(plain: str, coded: str) -> None:
    assert cobs_encode(bytes.fromhex(plain)) == bytes.fromhex(coded)
    assert cobs_decode(bytes.fromhex(coded)) == bytes.fromhex(plain)


@pytest.mark.parametrize("length", [253, 254, 255, 507, 508, 509, 1000])
@pytest.mark.parametrize("tail", [b"", b"\0", b"\0\1"])
def test_cobs_comes_back_at_the_lengths_of_full_blocks(length: int, tail: bytes) -> None:
    plain = (b"\x55" * length) + tail
    coded = cobs_encode(plain)
    assert 0 not in coded
    assert cobs_decode(coded) == plain


def test_cobs_of_254_bytes_has_no_empty_block_at_its_end() -> None:
    assert cobs_encode(bytes(range(1, 255))) == b"\xff" + bytes(range(1, 255))


def test_random_data_comes_back() -> None:
    rng = np.random.default_rng(1)
    for _ in range(300):
        plain = rng.choice([0, 1, 7], size=rng.integers(0, 600), p=[0.05, 0.5, 0.45])
        data = plain.astype(np.uint8).tobytes()
        assert unframe(frame(data)) == data


def test_no_damaged_or_cut_frame_passes() -> None:
    good = frame(bytes(range(40)))
    for place in range(len(good) - 1):
        assert unframe(good[:place]) is None
        for bit in range(8):
            bad = bytearray(good)
            bad[place] ^= 1 << bit
            assert unframe(bytes(bad)) is None


def _body() -> BodyPose:
    T = np.eye(4)
    T[:3, 3] = 1.5, -2.5, 3.25
    covariance = np.diag([0.01, 0.04, 0.01, 1e-4, 1e-4, 4e-4])
    unknown = np.full(3, np.nan)
    return BodyPose(7_000_123, T, covariance, np.array([0.5, 0.0, -0.25]), unknown, covariance, 257)


def test_a_pose_frame_reads_back_by_the_documented_layout() -> None:
    data = BinaryFrames(metric=True, level=False).pose(_body(), 0.754, 12_345_678)
    assert len(data) <= budget.BINARY_POSE_BYTES
    assert data.count(0) == 1
    payload = unframe(data)
    assert payload is not None
    kind, version, seq, flags, resets, quality, _, t_us, age_us, *numbers = (
        binary_frames.POSE_LAYOUT.unpack(payload)
    )
    assert (kind, version, seq, flags, resets, quality) == (1, 1, 0, 3, 1, 75)
    assert (t_us, age_us) == (7000, 12345)
    expected = [1.5, -2.5, 3.25, 1.0, 0.0, 0.0, 0.0, 0.5, 0.0, -0.25, 0.2, 0.02, 0.2]
    np.testing.assert_allclose(numbers, expected, rtol=1e-6)


def test_the_largest_pose_frame_is_what_the_budget_counts() -> None:
    size = binary_frames.POSE_LAYOUT.size
    assert len(frame(b"\1" * size)) == budget.BINARY_POSE_BYTES
    assert len(frame(b"\1" * binary_frames.STATUS_LAYOUT.size)) == budget.BINARY_STATUS_BYTES


def test_unknown_velocity_is_nan() -> None:
    body = _body()._replace(
        linear_m_s=np.full(3, np.nan), velocity_covariance=np.full((6, 6), np.nan)
    )
    payload = unframe(BinaryFrames(metric=True, level=True).pose(body, 1.0, 0))
    assert payload is not None
    numbers = np.array(binary_frames.POSE_LAYOUT.unpack(payload)[9:])
    assert np.isnan(numbers[[7, 8, 9, 12]]).all()
    assert not np.isnan(numbers[[0, 3, 10, 11]]).any()


def test_status_and_pose_share_one_counter() -> None:
    frames = BinaryFrames(metric=False, level=True)
    frames.pose(_body(), 1.0, 0)
    status = LinkStatus(5_000_000, False, OdometryState.LOST, 10, 7)
    payload = unframe(frames.status(status))
    assert payload is not None
    assert binary_frames.STATUS_LAYOUT.unpack(payload) == (2, 1, 1, 4, 3, 0, 5000, 10, 7)


def test_the_checksum_is_the_common_crc_32() -> None:
    decoded = cobs_decode(frame(b"123456789")[:-1])
    assert decoded is not None
    assert (
        decoded[-4:]
        == (0xCBF43926).to_bytes(4, "little")
        == binascii.crc32(b"123456789").to_bytes(4, "little")
    )


READER = """
#include <stdio.h>
int main(void) {
    uint8_t buffer[128];
    int length = 0, byte, size;
    while ((byte = getchar()) != EOF)
        if ((size = mapvo_byte((uint8_t)byte, buffer, &length)) > 0) {
            for (int i = 0; i < size; i++) printf("%02x", buffer[i]);
            printf("\\n");
        }
    return 0;
}
"""


@pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no C compiler")
def test_the_documented_reader_in_c_reads_what_is_sent(tmp_path: Path) -> None:
    document = Path(binary_frames.__file__).with_name("SERIAL.md").read_text()
    example = re.search(r"```c\n(.*?)```", document, re.DOTALL)
    assert example
    source = tmp_path / "reader.c"
    source.write_text(example[1] + READER)
    program = tmp_path / "reader"
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-fsanitize=undefined"]
    subprocess.run(["gcc", *strict, "-o", program, source], check=True)

    rng = np.random.default_rng(2)
    payloads = [
        rng.integers(0, 3, size=size, dtype=np.uint8).tobytes() for size in (1, 24, 72, 100) * 20
    ]
    stream = b"\x07garbage\0"
    for number, payload in enumerate(payloads):
        good = frame(payload)
        stream += good
        if number % 3 == 0:  # damaged, cut short, or far too long: none may pass or hide the next
            stream += good[: len(good) // 2] + b"\0" + good[:3] + b"\xaa" + good[4:] + b"\0"
            stream += rng.integers(0, 256, size=300, dtype=np.uint8).tobytes() + b"\0"
    read = subprocess.run([program], input=stream, capture_output=True, check=True)
    assert [bytes.fromhex(line) for line in read.stdout.decode().split()] == payloads
