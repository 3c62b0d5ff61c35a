# SPDX-License-Identifier: Apache-2.0
"""Looks at everything that stops such systems in the field, and says what to do."""

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

from edge.config import Config
from edge.outputs.capture_ring import room_bytes
from edge.runtime.doctor_camera import check_camera
from edge.runtime.doctor_host import Finding, Grade, Host, bad
from edge.runtime.doctor_outputs import check_map_and_outputs
from edge.runtime.doctor_system import check_system

log = logging.getLogger(__name__)


def examine(
    config: Config, host: Host | None = None, room: Callable[[Path], int] = room_bytes
) -> list[Finding]:
    """All findings, in the order of the way from the camera to the consumer.

    A check that fails itself is a finding, too: it must not hide the others.
    """
    host = host or Host()
    checks: dict[str, Callable[[], list[Finding]]] = {
        "camera": lambda: check_camera(host, config.camera),
        "map": lambda: check_map_and_outputs(host, config),
        "system": lambda: check_system(host, config, room),
    }
    findings: list[Finding] = []
    for subject, check in checks.items():
        try:
            findings += check()
        except Exception as error:  # whatever it is, the other checks go on
            log.debug("event=check_failed subject=%s", subject, exc_info=True)
            what = f"cannot be looked at: {type(error).__name__}: {error}"
            findings.append(bad(subject, what, "run `mapvo -v doctor` as the service's user"))
    return findings


def is_fit(findings: Sequence[Finding]) -> bool:
    """Whether nothing was found that will not work."""
    return all(finding.grade is not Grade.BAD for finding in findings)


def to_lines(findings: Sequence[Finding]) -> list[str]:
    """A line each, with the remedy where one is needed."""
    width = max((len(finding.subject) for finding in findings), default=0)
    lines = []
    for grade, subject, found, remedy in findings:
        line = f"{grade.value:4}  {subject:{width}}  {found}"
        lines.append(f"{line} -> {remedy}" if remedy else line)
    return lines
