# SPDX-License-Identifier: Apache-2.0
"""Whether the autopilot world understands the serial line: pymavlink and MAVProxy read it.

    python -m tools.peers RECORDING --map MAP [--mavproxy VENV] [--seconds 15]

Runs `mapvo run` with each preset on one end of a pair of pseudo terminals, as socat makes them,
and a peer on the other. MAVProxy lives in a virtual environment of its own, which is made where
VENV is not there: it brings an OpenCV that would replace ours. MAP is levelled in a copy if it is
not level. The exit status is 1 unless both understand everything.
"""

import argparse
import os
import select
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from pymavlink import mavutil

from edge.cli.command_line import positive
from edge.tiles.reader import open_map

BAUD = 921_600
COMPONENT = 197
POSES = {"px4": "ODOMETRY", "ardupilot": "VISION_POSITION_ESTIMATE"}
LEAST_POSES = 20  # how many there are depends on the machine and its load


class Heard(NamedTuple):
    """What a peer made of the line."""

    kinds: Counter[str]
    bad: int  # pieces that are no message

    def verdict(self, preset: str) -> str:
        """Empty if all is well."""
        poses = self.kinds[POSES[preset]]
        if self.bad:
            return f"{self.bad} pieces were not understood"
        if poses < LEAST_POSES:
            return f"only {poses} poses"
        missing = {"HEARTBEAT", "STATUSTEXT"} - set(self.kinds)
        return f"no {', '.join(sorted(missing))}" if missing else ""


def main(argv: list[str] | None = None) -> int:
    """Check both peers with both presets; 1 if one does not understand."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--map", type=Path, required=True)
    parser.add_argument("--mavproxy", type=Path, default=Path("out/mavproxy"), metavar="VENV")
    parser.add_argument("--seconds", type=positive, default=15)
    args = parser.parse_args(argv)
    mavproxy = find_mavproxy(args.mavproxy.resolve())
    failed = False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        map_folder = levelled(args.map, folder / "level.map")
        run_module("edge.cli", "warm-up")
        for preset in POSES:
            for peer in ("pymavlink", "MAVProxy"):
                with pty_pair() as (ours, theirs), daemon(args.recording, map_folder, preset, ours):
                    if peer == "MAVProxy":
                        heard = listen_by_mavproxy(theirs, mavproxy, folder, args.seconds)
                    else:
                        heard = listen(theirs, args.seconds)
                verdict = heard.verdict(preset)
                failed = failed or bool(verdict)
                kinds = ", ".join(f"{kind} {n}" for kind, n in sorted(heard.kinds.items()))
                print(f"{peer:10} {preset:10} {verdict or 'understands'}: {kinds}", flush=True)
    return int(failed)


def levelled(map_folder: Path, copy: Path) -> Path:
    """The map, or a level copy of it; which way is up does not matter here."""
    if open_map(map_folder).manifest.T_local_map is not None:
        return map_folder
    subprocess.run(["cp", "-r", map_folder, copy], check=True)
    run_module("maps.cli", "align", copy, "--up", "0,0,1")
    return copy


def run_module(*command: str | Path) -> None:
    """One of our own commands, to its end."""
    subprocess.run([sys.executable, "-m", *command], check=True, stdout=subprocess.DEVNULL)


def find_mavproxy(venv: Path) -> Path:
    """MAVProxy in `venv`, which is made if it is not there."""
    program = venv / "bin" / "mavproxy.py"
    if not program.exists():
        subprocess.run([sys.executable, "-m", "venv", venv], check=True)
        pip = [venv / "bin" / "python", "-m", "pip", "install", "--quiet", "MAVProxy"]
        subprocess.run(pip, check=True)
    return program


@contextmanager
def pty_pair() -> Iterator[tuple[str, str]]:
    """Names of two serial devices that are joined by a cable."""
    masters, names = [], []
    for _ in range(2):
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        masters.append(master)
        names.append((os.ttyname(slave), slave))
    ended = threading.Event()

    def carry() -> None:
        while not ended.is_set():
            for source in select.select(masters, [], [], 0.1)[0]:
                with suppress(BlockingIOError):  # nobody reads there: a real line loses it, too
                    os.write(masters[1 - masters.index(source)], os.read(source, 4096))

    cable = threading.Thread(target=carry)
    cable.start()
    try:
        yield names[0][0], names[1][0]
    finally:
        ended.set()
        cable.join()
        for descriptor in [*masters, *(slave for _, slave in names)]:
            os.close(descriptor)


@contextmanager
def daemon(recording: Path, map_folder: Path, preset: str, device: str) -> Iterator[None]:
    """`mapvo run` with that device as its serial line."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "mapvo.toml"
        config.write_text(
            f'[camera]\nrecording = "{recording}"\n[map]\nfolder = "{map_folder}"\n'
            f'[outputs.zmq]\nendpoint = "ipc://{folder}/stream"\ncontrol = ""\n'
            "[outputs.metrics]\nport = 0\n"
            f'[outputs.serial]\ndevice = "{device}"\nbaud = {BAUD}\npreset = "{preset}"\n'
        )
        command = [sys.executable, "-m", "edge.cli", "run", "--config", str(config)]
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
            try:
                yield
            finally:
                process.terminate()


def listen(device: str, seconds: float) -> Heard:
    """What pymavlink hears, from the first message on."""
    link = mavutil.mavlink_connection(device, baud=BAUD, dialect="common")
    assert link.recv_match(blocking=True, timeout=60) is not None, "nothing came"
    heard, until_s = [], time.monotonic() + seconds
    while time.monotonic() < until_s:
        message = link.recv_match(blocking=True, timeout=1)
        if message is not None:
            heard.append(message)
    link.close()
    return counted(heard)


def listen_by_mavproxy(device: str, program: Path, folder: Path, seconds: float) -> Heard:
    """What MAVProxy hears and writes into its log."""
    log = folder / "mavproxy.tlog"
    log.unlink(missing_ok=True)
    command = [program.with_name("python"), program, f"--master={device}", f"--baudrate={BAUD}"]
    options = ["--non-interactive", "--mav20", f"--logfile={log}", f"--state-basedir={folder}"]
    with subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        time.sleep(10 + seconds)  # its start takes some seconds
        process.terminate()
        said = process.communicate()[0]
    if not log.exists():
        sys.exit(f"MAVProxy wrote no log; it said:\n{said}")
    tlog = mavutil.mavlink_connection(str(log), dialect="common")
    heard = []
    while (message := tlog.recv_msg()) is not None:
        heard.append(message)
    return counted([item for item in heard if item.get_srcComponent() == COMPONENT])


def counted(messages: list[mavutil.mavlink.MAVLink_message]) -> Heard:
    """By kind; what comes from elsewhere is bad as well."""
    kinds = Counter(message.get_type() for message in messages)
    bad = kinds.pop("BAD_DATA", 0)
    strange = sum(
        message.get_type() != "BAD_DATA" and message.get_srcComponent() != COMPONENT
        for message in messages
    )
    return Heard(kinds, bad + strange)


if __name__ == "__main__":
    sys.exit(main())
