# SPDX-License-Identifier: Apache-2.0
"""A serial line that may be unplugged, filled up or held by a reader that sleeps.

Writing never waits: what does not fit is dropped, since a newer pose follows.
"""

import errno
import logging
import os
import termios

import serial

log = logging.getLogger(__name__)

_RETRY_FIRST_NS = 200_000_000
_RETRY_MOST_NS = 2_000_000_000
# A line that takes nothing for so long holds old poses: they are thrown away.
_STALLED_NS = 500_000_000
# So many bytes without a halt, more than any kernel holds, show that somebody reads again.
_RESUMED_BYTES = 100_000
# What the kernel may still hold when the next message is handed over: more is delay.
_QUEUED_S = 0.02
_QUEUED_LEAST_BYTES = 256
_BUSY = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EINTR)
_REMEDIES = {
    errno.ENOENT: "plug it in or name another outputs.serial.device",
    errno.EACCES: "add the user to the group that owns it, mostly dialout",
    errno.EBUSY: "end the other program that uses it, maybe ModemManager",
    errno.EAGAIN: "end the other program that uses it",
}


class SerialPort:
    """Hands whole messages to a serial device as long as it is there and takes them.

    The time comes from the caller. Opening may take a slow USB device a while, so the
    thread that owns this is not the one that tracks.
    """

    def __init__(self, device: str, baud: int) -> None:
        self._device = device
        self._baud = baud
        self._port: serial.Serial | None = None
        self._fd = -1
        self._rest = b""
        self._progress_ns = 0
        self._retry_at_ns = 0
        self._retry_after_ns = _RETRY_FIRST_NS
        self._said = ""
        self._stalled = False
        self._since_stall_bytes = 0
        self.sent = 0
        self.dropped = 0

    @property
    def is_open(self) -> bool:
        """Whether the device is there, as far as the last write knows."""
        return self._port is not None

    def write(self, message: bytes, now_ns: int) -> bool:
        """Hand `message` over whole, or drop it; say which.

        An empty message only tries to open the device and to move on what is left.
        """
        taken = self._is_ready(now_ns) and self._push(message, now_ns)
        if message:
            self.sent += taken
            self.dropped += not taken
        return taken

    def close(self) -> None:
        """Throw away what waits and free the device."""
        self._abandon()

    def _is_ready(self, now_ns: int) -> bool:
        """Whether the device is there and all before has gone out."""
        if self._port is None and not self._open(now_ns):
            return False
        if self._rest and not self._push(b"", now_ns):
            return False
        return self._has_room(now_ns)

    def _open(self, now_ns: int) -> bool:
        if now_ns < self._retry_at_ns:
            return False
        try:
            port = serial.Serial(
                self._device, self._baud, timeout=0, write_timeout=0, exclusive=True
            )
        except (OSError, ValueError, termios.error) as error:  # the first is SerialException's base
            self._retry_at_ns = now_ns + self._retry_after_ns
            self._retry_after_ns = min(2 * self._retry_after_ns, _RETRY_MOST_NS)
            self._say_unopened(error)
            return False
        self._port, self._fd = port, port.fileno()
        self._rest, self._stalled, self._progress_ns = b"", False, now_ns
        self._retry_after_ns, self._said = _RETRY_FIRST_NS, ""
        log.info("event=serial_open device=%s baud=%d", self._device, self._baud)
        return True

    def _say_unopened(self, error: Exception) -> None:
        """One line for each new reason, not one for each attempt."""
        code = next((item for item in error.args if isinstance(item, int)), None)
        reason = os.strerror(code) if code else str(error)
        if reason == self._said:
            return
        self._said = reason
        remedy = _REMEDIES.get(code or 0, "it must be a serial device that takes this baud rate")
        log.warning("event=serial_unavailable device=%s: %s: %s", self._device, reason, remedy)

    def _has_room(self, now_ns: int) -> bool:
        """Whether the kernel holds so little that a new message goes out at once."""
        assert self._port is not None
        most = max(round(self._baud / 10 * _QUEUED_S), _QUEUED_LEAST_BYTES)
        try:
            waiting = self._port.out_waiting
        except OSError as error:
            return self._lose(error, now_ns)
        if waiting <= most:
            return True
        return self._wait(now_ns)

    def _push(self, message: bytes, now_ns: int) -> bool:
        """Write the rest of the last message, then `message`; say whether its start went out."""
        data = self._rest + message
        if not data:
            return True
        try:
            # Not Serial.write: with a full line and no timeout it spins for ever.
            count = os.write(self._fd, data)
        except OSError as error:
            if error.errno in _BUSY:
                return self._wait(now_ns)
            return self._lose(error, now_ns)
        self._progress_ns = now_ns
        self._since_stall_bytes += count
        if self._stalled and self._since_stall_bytes > _RESUMED_BYTES:
            self._stalled = False
            log.info("event=serial_resumed device=%s dropped=%d", self._device, self.dropped)
        self._rest = data[count:]
        return message != b"" or not self._rest

    def _wait(self, now_ns: int) -> bool:
        """Nothing goes out now; after a while, what waits is thrown away."""
        if now_ns - self._progress_ns > _STALLED_NS:
            assert self._port is not None
            if not self._stalled:
                self._stalled = True
                log.warning("event=serial_stalled device=%s: nobody reads", self._device)
            self._rest, self._progress_ns, self._since_stall_bytes = b"", now_ns, 0
            try:
                self._port.reset_output_buffer()
            except (OSError, termios.error) as error:
                return self._lose(error, now_ns)
        return False

    def _lose(self, error: Exception, now_ns: int) -> bool:
        log.warning("event=serial_lost device=%s: %s: waiting for its return", self._device, error)
        self._abandon()
        self._retry_at_ns = now_ns + self._retry_after_ns
        return False

    def _abandon(self) -> None:
        port, self._port, self._fd, self._rest = self._port, None, -1, b""
        if port is None:
            return
        try:
            port.reset_output_buffer()  # else closing waits until the line has taken it all
        except (OSError, termios.error):
            log.debug("event=serial_flush_failed device=%s", self._device)
        try:
            port.close()
        except OSError:
            log.debug("event=serial_close_failed device=%s", self._device)
