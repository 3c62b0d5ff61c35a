# SPDX-License-Identifier: Apache-2.0
"""Log lines as journald likes them: its own stamps, our priority."""

import logging
import os

_PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.DEBUG, 7))


class _JournalFormatter(logging.Formatter):
    """Puts the priority before each line (sd-daemon(3))."""

    def format(self, record: logging.LogRecord) -> str:
        priority = next((code for level, code in _PRIORITIES if record.levelno >= level), 7)
        return "\n".join(f"<{priority}>{line}" for line in super().format(record).splitlines())


def log_for_daemon() -> None:
    """Log from INFO on; where journald reads, without what it adds by itself."""
    formatter: logging.Formatter
    if "JOURNAL_STREAM" in os.environ:
        formatter = _JournalFormatter("%(name)s %(message)s")
    else:
        formatter = logging.Formatter("%(asctime)s %(levelname)s %(name)s %(message)s")
    root = logging.getLogger()
    root.setLevel(min(root.level, logging.INFO))
    for handler in root.handlers:
        handler.setFormatter(formatter)
