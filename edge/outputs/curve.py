# SPDX-License-Identifier: Apache-2.0
"""Encryption of the sockets, and who may connect: ZeroMQ's CURVE with an allow-list.

Key files are text: one Z85 key of 40 characters a line, `#` begins a comment.
"""

import logging
import struct
from pathlib import Path

import zmq
from zmq.utils import z85

from edge.config.outputs import CurveConfig
from edge.errors import ConfigError, OutputError
from edge.store import durable

log = logging.getLogger(__name__)

_KEY_LENGTH = 40  # characters of Z85
_DOMAIN = b"mapvo"
_ZAP_ENDPOINT = "inproc://zeromq.zap.01"
_MAX_FILE_BYTES = 1 << 20
# A stranger that knocks again and again is said this often, and counted in between.
_SAY_EVERY = 100
_NO_HANDSHAKE = (
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL  # speaks another mechanism, or none
)


class CurveServer:
    """Decides which clients may connect, and counts those that may not.

    Made and given to sockets in one thread, then owned by the one that calls `answer`.
    """

    def __init__(self, config: CurveConfig, context: "zmq.Context[zmq.Socket[bytes]]") -> None:
        self._secret = read_keys(Path(config.secret_key))[0]
        self._file = Path(config.clients)
        self._clients = allowed_clients(self._file)
        self._stamp = _stamp(self._file)
        self.refused = 0
        self._monitors: list[zmq.Socket[bytes]] = []
        self._socket = context.socket(zmq.REP)
        self._socket.linger = 0
        self._socket.bind(_ZAP_ENDPOINT)

    @property
    def sockets(self) -> "list[zmq.Socket[bytes]]":
        """What to poll; when one is readable, call `answer`."""
        return [self._socket, *self._monitors]

    def protect(self, socket: "zmq.Socket[bytes]") -> None:
        """Let `socket`, not yet bound, take encrypted connections of known clients only."""
        socket.curve_server = True
        socket.curve_secretkey = self._secret
        socket.zap_domain = _DOMAIN
        self._monitors.append(socket.get_monitor_socket(_NO_HANDSHAKE))

    def answer(self) -> None:
        """Answer whoever has knocked; never waits."""
        try:
            while True:
                self._socket.send_multipart(self._judge(self._socket.recv_multipart(zmq.DONTWAIT)))
        except zmq.Again:
            pass
        for monitor in self._monitors:
            while monitor.poll(0):
                monitor.recv_multipart()
                self._count("client without a key")

    def close(self) -> None:
        """Free the sockets."""
        for socket in self.sockets:
            socket.close(linger=0)

    def _judge(self, request: list[bytes]) -> list[bytes]:
        """The answer to one request by ZeroMQ's authentication protocol (RFC 27)."""
        version, request_id, _domain, address, _identity, mechanism, *credentials = request
        self._read_again()
        key = z85.encode(credentials[0]) if mechanism == b"CURVE" and credentials else b""
        if key in self._clients:
            return [version, request_id, b"200", b"OK", key, b""]
        self._count(f"client {address.decode('ascii', 'replace')} key {key.decode('ascii')}")
        return [version, request_id, b"400", b"not on the list", b"", b""]

    def _count(self, who: str) -> None:
        if self.refused % _SAY_EVERY == 0:
            log.warning("event=client_refused who=%r so_far=%d", who, self.refused + 1)
        self.refused += 1

    def _read_again(self) -> None:
        """Take over a changed list; one that cannot be read changes nothing."""
        stamp = _stamp(self._file)
        if stamp == self._stamp:
            return
        self._stamp = stamp
        try:
            self._clients = allowed_clients(self._file)
        except ConfigError as error:
            log.warning("event=clients_unreadable %s: the last list stays", error)
        else:
            log.info("event=clients_read file=%s keys=%d", self._file, len(self._clients))


def allowed_clients(path: Path) -> frozenset[bytes]:
    """Public keys in the file; an empty file lets nobody in."""
    return frozenset(read_keys(path, at_least=0))


def read_keys(path: Path, at_least: int = 1) -> list[bytes]:
    """The Z85 keys in a key file, or ConfigError with the line that is none."""
    try:
        with path.open(encoding="ascii") as file:
            lines = file.read(_MAX_FILE_BYTES).splitlines()
    except OSError as error:
        reason = error.strerror or error
        raise ConfigError(f"{path}: cannot be read: {reason}; `mapvo client-key`") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is no key file; `mapvo client-key` makes one") from error
    keys = []
    for number, line in enumerate(lines, start=1):
        # `#` is a character of keys as well, though no key begins with it.
        text = line.split(" #")[0].strip()
        if not text or text.startswith("#"):
            continue
        if not _is_key(text):
            raise ConfigError(f"{path}, line {number}: is no key of 40 characters")
        keys.append(text.encode("ascii"))
    if len(keys) < at_least:
        raise ConfigError(f"{path}: holds no key; `mapvo client-key` makes one")
    return keys


def make_key_pair(path: Path) -> Path:
    """Write a new secret key to `path` and its public one beside it; return where that is."""
    public, secret = zmq.curve_keypair()
    public_path = path.with_suffix(".pub")
    made: list[Path] = []
    for target, key, mode in ((path, secret, 0o600), (public_path, public, 0o644)):
        try:
            durable.write_new(target, [key + b"\n"], mode)
        except OSError as error:
            for half in made:
                half.unlink()
            reason = error.strerror or error
            raise OutputError(f"{target}: cannot be made: {reason}; name a new file") from error
        made.append(target)
    return public_path


def _is_key(text: str) -> bool:
    try:
        return len(text) == _KEY_LENGTH and len(z85.decode(text.encode("ascii"))) == 32
    except (ValueError, KeyError, struct.error):
        return False


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size
