# SPDX-License-Identifier: Apache-2.0
"""Where results go."""

from typing import Annotated, Literal

from msgspec import Meta, Struct, field

from edge.config.serial import SerialConfig

_FORM = "tcp://ADDRESS:PORT or ipc://PATH"
_Endpoint = Annotated[str, Meta(pattern=r"^(tcp|ipc)://.+", description=_FORM)]
_EndpointOrNone = Annotated[
    str, Meta(pattern=r"^((tcp|ipc)://.+)?$", description=f"{_FORM}, or empty")
]


class CurveConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Encryption and an allow-list for both sockets; `mapvo client-key` makes key pairs."""

    # File with this device's secret key; empty: no encryption, and whoever connects may read.
    secret_key: str = ""
    # File with the public keys that may connect, one a line; read again when it changes.
    clients: str = ""

    def __post_init__(self) -> None:
        if bool(self.secret_key) != bool(self.clients):
            raise ValueError("secret_key and clients are needed both, or neither")


class ZmqConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The live stream of poses; edge/outputs/PROTOCOL.md describes it."""

    # Loopback only, since whoever connects may read; name an interface to open it.
    endpoint: _Endpoint = "tcp://127.0.0.1:5580"
    # `msgpack` is half as large; `json` is for readers without a library.
    format: Literal["msgpack", "json"] = "msgpack"
    # Commands: status, reset, start pose, swap. Empty: none are taken.
    control: _EndpointOrNone = "tcp://127.0.0.1:5581"
    curve: CurveConfig = field(default_factory=CurveConfig)
    # A replay that is not in real time publishes only on demand: nobody watches a bench.
    in_replay: bool = False
    # Messages kept for a slow subscriber; further ones are lost to it until it has read some.
    queue_messages: Annotated[int, Meta(ge=1, le=10_000)] = 64
    # Between two status messages.
    status_interval_s: Annotated[float, Meta(gt=0.0, le=60.0)] = 1.0

    def __post_init__(self) -> None:
        if self.control and not self.curve.secret_key and not _is_local(self.control):
            raise ValueError(
                f"control {self.control} is open to others than this machine: set curve, or "
                "tcp://127.0.0.1:5581"
            )


class MetricsConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Figures for Prometheus, as text over HTTP."""

    # 0: none.
    port: Annotated[int, Meta(ge=0, le=65535)] = 9580
    # Loopback only; there is no password.
    address: str = "127.0.0.1"


class OutputsConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All outputs."""

    zmq: ZmqConfig = field(default_factory=ZmqConfig)
    serial: SerialConfig = field(default_factory=SerialConfig)
    metrics: MetricsConfig = field(default_factory=MetricsConfig)


def _is_local(endpoint: str) -> bool:
    return endpoint.startswith(("ipc://", "tcp://127.", "tcp://localhost:", "tcp://[::1]:"))
