# SPDX-License-Identifier: Apache-2.0
"""Something has come or gone: the message of the topic `change`."""

from edge.outputs.rows import EvidenceRows, change_row
from edge.outputs.stamp import SCHEMA_VERSION, Stamp
from edge.types import ChangeEvent


class ChangeMessage(Stamp, frozen=True):
    """Topic `change`: one change of the map's objects, once it is sure."""

    id: int
    kind: str  # added or removed
    label: str
    score: float  # 0 to 1
    center_map_m: tuple[float, ...]
    extent_m: tuple[float, ...]
    n_views: int  # distinct viewpoints that say so
    evidence: EvidenceRows


def change_message(event: ChangeEvent, seq: int, sent_ns: int) -> ChangeMessage:
    """Message of a change."""
    row = change_row(event)
    return ChangeMessage(
        schema=SCHEMA_VERSION,
        seq=seq,
        sent_ns=sent_ns,
        t_ns=row.t_ns,
        id=row.id,
        kind=row.kind,
        label=row.label,
        score=row.score,
        center_map_m=row.center_map_m,
        extent_m=row.extent_m,
        n_views=row.n_views,
        evidence=row.evidence,
    )
