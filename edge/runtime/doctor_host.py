# SPDX-License-Identifier: Apache-2.0
"""What the doctor sees of a machine; tests give folders of their own."""

import grp
import os
import pwd
import stat
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import NamedTuple


class Grade(Enum):
    """How bad it is."""

    GOOD = "ok"
    DOUBTFUL = "warn"  # it works, but not as well as it could
    BAD = "bad"  # it will not work


class Finding(NamedTuple):
    """One line: what was found, and what to do."""

    grade: Grade
    subject: str
    found: str
    remedy: str = ""


def good(subject: str, found: str) -> Finding:
    """All is well."""
    return Finding(Grade.GOOD, subject, found)


def doubtful(subject: str, found: str, remedy: str) -> Finding:
    """It works, but not as well as it could."""
    return Finding(Grade.DOUBTFUL, subject, found, remedy)


def bad(subject: str, found: str, remedy: str) -> Finding:
    """It will not work."""
    return Finding(Grade.BAD, subject, found, remedy)


@dataclass(frozen=True)
class Account:
    """Who asks."""

    uid: int = field(default_factory=os.geteuid)
    groups: frozenset[int] = field(
        default_factory=lambda: frozenset({os.getegid(), *os.getgroups()})
    )

    @property
    def name(self) -> str:
        """As people know it."""
        try:
            return pwd.getpwuid(self.uid).pw_name
        except KeyError:
            return str(self.uid)


@dataclass(frozen=True)
class Host:
    """Files of the system below `root`, as the account may use them."""

    root: Path = Path("/")
    account: Account = field(default_factory=Account)

    def path(self, name: str) -> Path:
        """Where the file that is called `name` lies."""
        return self.root / str(Path(name).absolute()).lstrip("/")

    def read(self, name: str) -> str | None:
        """Text of a small file; None where there is none or it may not be read."""
        try:
            return self.path(name).read_text(encoding="utf-8", errors="replace").strip("\0 \n")
        except OSError:
            return None

    def number(self, name: str) -> float | None:
        """Number in a small file."""
        try:
            return float(self.read(name) or "")
        except ValueError:
            return None

    def glob(self, pattern: str) -> list[Path]:
        """Files whose names fit, in their order."""
        return sorted(self.root.glob(pattern.lstrip("/")))

    def texts(self, pattern: str) -> list[str]:
        """Texts of the files whose names fit and that can be read."""
        found = (self.read(f"/{path.relative_to(self.root)}") for path in self.glob(pattern))
        return [text for text in found if text]

    def processes(self) -> set[str]:
        """Names of all that run."""
        return set(self.texts("/proc/*/comm"))

    def refusal(self, path: Path) -> str | None:
        """Why the account may not read and write a device, as a remedy; None where it may."""
        status = path.stat()
        mode, both = status.st_mode, 0o6
        if self.account.uid in (0, status.st_uid) and (mode >> 6) & both == both:
            return None
        if self.account.uid == 0:
            return None
        if status.st_gid in self.account.groups and (mode >> 3) & both == both:
            return None
        if mode & both == both:
            return None
        if (mode >> 3) & both == both:
            group = _group_name(status.st_gid)
            return f"sudo usermod -aG {group} {self.account.name}, then log in again"
        return f"its mode is {stat.filemode(mode)}: add a udev rule that opens it to a group"


def _group_name(gid: int) -> str:
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)
