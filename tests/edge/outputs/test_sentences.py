# SPDX-License-Identifier: Apache-2.0
import re

import numpy as np

from edge.config import serial as budget
from edge.geometry import se3
from edge.outputs.frames import BodyPose
from edge.outputs.sentences import Sentences, sentence
from edge.outputs.serial_stream import LinkStatus
from edge.types import OdometryState

FORM = re.compile(rb"\$(?P<body>[\x20-\x7e]+)\*(?P<sum>[0-9A-F]{2})\r\n")


def _fields(line: bytes) -> list[str]:
    """Fields of a sentence whose checksum is right."""
    match = FORM.fullmatch(line)
    assert match
    total = 0
    for byte in match["body"]:
        total ^= byte
    assert total == int(match["sum"], 16)
    return match["body"].decode().split(",")


def _body(position: list[float], linear: float = 0.5) -> BodyPose:
    T = se3.from_rotation_translation(np.diag([-1.0, -1.0, 1.0]), position)
    covariance = np.diag([0.01, 0.04, 0.01, 1e-4, 1e-4, 4e-4])
    velocity = np.full(3, linear)
    return BodyPose(7_000_123, T, covariance, velocity, velocity, covariance, 258)


def test_the_checksum_is_nmeas() -> None:
    # A sentence of a public GPS log.
    fields = ["GPGLL", "5300.97914", "N", "00259.98174", "E", "125926", "A"]
    assert sentence(*fields) == b"$GPGLL,5300.97914,N,00259.98174,E,125926,A*28\r\n"


def test_a_pose_reads_back() -> None:
    fields = _fields(Sentences(metric=True, level=True).pose(_body([1.5, -0.00001, 3]), 0.5, 2000))
    assert fields[:4] == ["MVPOS", "0", "7000", "2"]
    assert fields[4:7] == ["1.5000", "0.0000", "3.0000"]
    assert fields[7:11] == ["0.000000", "0.000000", "0.000000", "1.000000"]
    assert fields[11:] == ["0.500", "0.500", "0.500", "0.2000", "1.146", "50", "2"]


def test_an_unknown_number_is_an_empty_field() -> None:
    line = Sentences(metric=True, level=True).pose(_body([0, 0, 0], np.nan), 0.5, 0)
    assert _fields(line)[11:14] == ["", "", ""]


def test_status_counts_on_with_the_poses() -> None:
    sentences = Sentences(metric=True, level=False)
    sentences.pose(_body([0, 0, 0]), 1.0, 0)
    fields = _fields(sentences.status(LinkStatus(9_000, True, OdometryState.TRACKING, 5, 4)))
    assert fields == ["MVSTA", "1", "9", "1", "tracking", "5", "4", "1", "0"]


def test_the_longest_sentences_fit_the_budget() -> None:
    sentences = Sentences(metric=True, level=True)
    body = _body([-99999.99999] * 3, -1234.5)._replace(t_ns=2**63 - 1, covariance=np.eye(6) * 1e8)
    for _ in range(99_999):
        sentences._next()
    assert len(sentences.pose(body, 1.0, 2**42)) <= budget.SENTENCE_POSE_BYTES
    status = LinkStatus(2**63 - 1, True, OdometryState.INITIALISING, 10**9, 10**9)
    assert len(sentences.status(status)) <= budget.SENTENCE_STATUS_BYTES
