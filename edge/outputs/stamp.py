# SPDX-License-Identifier: Apache-2.0
"""The head that all messages of the live stream share."""

import msgspec

SCHEMA_VERSION = 1


class Stamp(msgspec.Struct, frozen=True):
    """Head of every message."""

    schema: int
    seq: int  # counts the messages of its topic from 0; a gap is a loss
    sent_ns: int  # monotonic clock of the sending machine
    t_ns: int  # mid-exposure of the frame
