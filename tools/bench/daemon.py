# SPDX-License-Identifier: Apache-2.0
"""How late, large and busy the daemon is, beside what is wanted.

    python -m tools.bench.daemon RECORDING --map MAP [--seconds 600]

Runs `mapvo run` on the recording, played forth and back at its own rate, with a subscriber for
all topics and a reader on a pseudo terminal as its serial line, and prints our figures beside
what is wanted. Latency is from mid-exposure to the subscriber's hands, in this process.
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
from pathlib import Path

import numpy as np
import zmq

from edge.outputs import wire

REALTIME_HELP = "real-time priority for what makes poses: on a machine that others use, as root"
_FIRST, _SECOND = 20, 10  # real-time priorities: tracking and camera, other threads
START_FRAMES = 60  # of the measurement: caches fill, the odometry starts


def main(argv: list[str] | None = None) -> int:
    """Run and print; 0 unless the daemon ended by itself."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--map", type=Path)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--preset", choices=("lean", "fine"), default="lean")
    parser.add_argument("--realtime", action="store_true", help=REALTIME_HELP)
    parser.add_argument("--more", default="", help="further lines for the settings file")
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        return Bench(args, Path(folder)).run()


class Bench:
    """One daemon and its two listeners."""

    def __init__(self, args: argparse.Namespace, folder: Path) -> None:
        self._args = args
        self._endpoint = f"ipc://{folder}/stream"
        self._config = folder / "mapvo.toml"
        self._master, slave = os.openpty()
        tty.setraw(slave)
        where = f'[map]\nfolder = "{args.map}"\n' if args.map else ""
        self._config.write_text(
            f'[camera]\nrecording = "{args.recording}"\n{where}'
            f'[odometry]\npreset = "{args.preset}"\n'
            f'[outputs.zmq]\nendpoint = "{self._endpoint}"\ncontrol = "ipc://{folder}/control"\n'
            f"[outputs.metrics]\nport = 0\n"
            f'[outputs.serial]\ndevice = "{os.ttyname(slave)}"\nprotocol = "binary"\n{args.more}\n'
        )
        self._serial_bytes = 0
        self._ended = False
        self.latency_ms: list[float] = []
        self.children_cpu_s = 0.0  # of its child processes, such as a model's
        self._frame_gaps: list[int] = []
        self._memory_mb: list[float] = []
        self._heard: Counter[str] = Counter()
        self._first_status_s = float("nan")
        self.status: wire.StatusMessage | None = None

    def run(self) -> int:
        """Listen for the given time, then print."""
        reader = threading.Thread(target=self._read_serial)
        reader.start()
        began = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", "edge.cli", "run", "--config", str(self._config)]
        )
        try:
            cpu_s, wall_s = self._listen(process, began)
            if process.poll() is None:
                self.children_cpu_s = _children_cpu_s(process.pid)
            threads = _thread_cpu(process.pid) if process.poll() is None else {}
            peak_mb = _memory(process.pid, "VmHWM") if process.poll() is None else float("nan")
        finally:
            process.terminate()
            process.wait()
            self._ended = True
            reader.join()
        self._print(cpu_s, wall_s, peak_mb, threads)
        return 0

    def _listen(self, process: "subprocess.Popen[bytes]", began: float) -> tuple[float, float]:
        context = zmq.Context()
        socket = context.socket(zmq.SUB)
        socket.subscribe("")
        socket.connect(self._endpoint)
        cpu_then = wall_then = None
        while time.monotonic() - began < self._args.seconds and process.poll() is None:
            if not socket.poll(200):
                continue
            topic, message = wire.decode(socket.recv())
            now_ns = time.monotonic_ns()
            self._heard[topic] += 1
            if isinstance(message, wire.StatusMessage):
                if self.status is None:
                    self._first_status_s = time.monotonic() - began
                self.status = message
                self._memory_mb.append(_memory(process.pid, "VmRSS"))
            elif isinstance(message, wire.OdomMessage):
                if message.seq == START_FRAMES:
                    if self._args.realtime:
                        _make_realtime(process.pid)
                    cpu_then, wall_then = _cpu_s(process.pid), time.monotonic()
                elif message.seq > START_FRAMES:
                    self.latency_ms.append((now_ns - message.t_ns) * 1e-6)
        socket.close(linger=0)
        context.term()
        if cpu_then is None or wall_then is None or process.poll() is not None:
            return float("nan"), float("nan")
        return _cpu_s(process.pid) - cpu_then, time.monotonic() - wall_then

    def _read_serial(self) -> None:
        while not self._ended:
            if select.select([self._master], [], [], 0.2)[0]:
                self._serial_bytes += len(os.read(self._master, 65536))

    def _print(
        self, cpu_s: float, wall_s: float, peak_mb: float, threads: dict[str, float]
    ) -> None:
        status = self.status
        if status is None or not self.latency_ms:
            print("the daemon said nothing")
            return
        latency = np.percentile(self.latency_ms, (50, 95, 99, 100))
        memory = self._memory_mb
        quarter = max(len(memory) // 4, 1)
        growth = float(np.median(memory[-quarter:]) - np.median(memory[quarter : 2 * quarter]))
        rows = [
            ("start to first status [s]", f"{self._first_status_s:.2f}", "<= 3"),
            ("frames a second", f"{len(self.latency_ms) / wall_s:.2f}", "the recording's"),
            ("frames", f"{status.frames}", ""),
            ("dropped", f"{status.dropped_frames}", "0"),
            ("with a map pose", f"{status.published}", ""),
            ("capture to subscriber, median [ms]", f"{latency[0]:.1f}", ""),
            ("p95 [ms]", f"{latency[1]:.1f}", ""),
            ("p99 [ms]", f"{latency[2]:.1f}", "<= 50 (33 without listeners)"),
            ("largest [ms]", f"{latency[3]:.1f}", ""),
            ("CPU [cores]", f"{cpu_s / wall_s:.2f}", "<= 1.2 lean"),
            ("CPU a frame [ms]", f"{1e3 * cpu_s / len(self.latency_ms):.1f}", "<= 25 lean"),
            ("memory, peak [MB]", f"{peak_mb:.0f}", "<= 200"),
            ("memory, growth 2nd to 4th quarter [MB]", f"{growth:+.1f}", "flat"),
            ("serial line [kB]", f"{self._serial_bytes / 1e3:.0f}", ""),
            ("ladder level at the end", f"{status.level}", "0"),
        ]
        print(f"\n{'mapvo run':42} {'ours':>10}   wanted")
        for name, ours, wanted in rows:
            print(f"{name:42} {ours:>10}   {wanted}")
        print("\nCPU of its threads [s]: " + ", ".join(f"{k} {v:.1f}" for k, v in threads.items()))


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    ticks = sum(int(fields[index]) for index in (11, 12, 13, 14))
    return float(ticks / os.sysconf("SC_CLK_TCK"))


def _make_realtime(pid: int) -> None:
    """Let no other job of the machine delay the threads that make poses, nor this one."""
    policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK  # not for the processes of models
    os.sched_setscheduler(0, policy, os.sched_param(_FIRST))
    for task in Path(f"/proc/{pid}/task").iterdir():
        # All of them: whoever holds the interpreter must not wait for a core.
        is_first = (task / "comm").read_text().strip() == "camera" or int(task.name) == pid
        priority = os.sched_param(_FIRST if is_first else _SECOND)
        os.sched_setscheduler(int(task.name), policy, priority)


def _children_cpu_s(pid: int) -> float:
    children = Path(f"/proc/{pid}/task").glob("*/children")
    found = [int(child) for file in children for child in file.read_text().split()]
    return float(sum(map(_cpu_s, found)))


def _thread_cpu(pid: int) -> dict[str, float]:
    found: Counter[str] = Counter()
    for task in Path(f"/proc/{pid}/task").iterdir():
        stat = (task / "stat").read_text()
        fields = stat.rpartition(")")[2].split()
        name = f"{stat.partition('(')[2].rpartition(')')[0]}-{task.name}"
        found[name] += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return dict(found.most_common(8))


def _memory(pid: int, key: str) -> float:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1]) / 1024.0
    return float("nan")


if __name__ == "__main__":
    sys.exit(main())
