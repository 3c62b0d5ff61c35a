# SPDX-License-Identifier: Apache-2.0
"""Where results go."""

from typing import Annotated

from msgspec import Meta, Struct, field


class ZmqConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The live stream of poses; edge/outputs/PROTOCOL.md describes it."""

    # Loopback only, since whoever connects may read; name an interface to open it.
    endpoint: Annotated[str, Meta(pattern=r"^(tcp|ipc)://.+")] = "tcp://127.0.0.1:5580"
    # A replay that is not in real time publishes only on demand: nobody watches a bench.
    in_replay: bool = False
    # Messages kept for a slow subscriber; further ones are lost to it until it has read some.
    queue_messages: Annotated[int, Meta(ge=1, le=10_000)] = 64
    # Between two status messages.
    status_interval_s: Annotated[float, Meta(gt=0.0, le=60.0)] = 1.0


class OutputsConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All outputs."""

    zmq: ZmqConfig = field(default_factory=ZmqConfig)
