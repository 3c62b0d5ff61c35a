# SPDX-License-Identifier: Apache-2.0
"""Swaps the map under a live run, many times: poses all the while, and nothing that grows.

    python -m tools.bench.swaps RECORDING MAP MAP [--swaps 1000]

Runs `mapvo run` on the recording, forth and back, with two maps of the place in its store, and
exchanges them again and again as `mapvo tiles activate` does. Frames without a pose are counted
over ZeroMQ, memory and open files over /proc.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

import msgspec
import zmq

from edge.outputs import wire
from edge.store.bundle import Device, open_bundle
from edge.store.store import Store
from edge.store.trust import TrustedKeys
from maps.bundle import BundleOrder, bundle
from maps.bundle_keys import make_key

CONFIG = """
[camera]
source = "recording"
recording = "{recording}"
[tiles]
store = "{store}"
good_after_s = 1.0
[outputs.zmq]
endpoint = "ipc://{endpoint}"
control = "ipc://{endpoint}.control"
[outputs.metrics]
port = 0
"""


class Gap(NamedTuple):
    """Time without a pose, and the frames in it."""

    ms: float
    frames: int


class Listener:
    """Hears every frame; owns its thread."""

    def __init__(self, endpoint: str) -> None:
        self.frames = self.poses = 0
        self.worst = Gap(0.0, 0)
        self.jumps = 0
        self._last_pose_ns: int | None = None
        self._missing = 0
        self._stopped = False
        self._endpoint = endpoint
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def forget(self) -> None:
        """Count anew from now on."""
        self.frames = self.poses = 0
        self.worst = Gap(0.0, 0)

    def stop(self) -> None:
        """End the thread."""
        self._stopped = True
        self._thread.join()

    def _run(self) -> None:
        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            socket.rcvhwm = 10_000
            socket.rcvtimeo = 200
            for topic in ("pose ", "odom "):
                socket.subscribe(topic)
            socket.connect(f"ipc://{self._endpoint}")
            while not self._stopped:
                try:
                    _, message = wire.decode(socket.recv())
                except zmq.Again:
                    continue
                if isinstance(message, wire.PoseMessage):
                    self._pose(message.t_ns)
                else:
                    self.frames += 1
                    self._missing += 1

    def _pose(self, t_ns: int) -> None:
        self.poses += 1
        if self._last_pose_ns is not None:
            gap = Gap(abs(t_ns - self._last_pose_ns) * 1e-6, max(self._missing - 1, 0))
            self.worst = max(self.worst, gap)
        self._last_pose_ns, self._missing = t_ns, 0


def resident_mb(pid: int) -> float:
    """Resident memory of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def install(store: Store, maps: list[Path], work: Path) -> list[int]:
    """Bundle the maps and install them; the first is current and good."""
    key = make_key(work / "key.pem")
    keys = TrustedKeys([work])
    numbers = []
    for version, folder in enumerate(maps, start=1):
        out = work / f"{version}.mapbundle"
        bundle(folder, key.private, out, BundleOrder(site="bench", map_version=version))
        with open_bundle(out, keys) as opened:
            numbers.append(store.install(opened, Device(runtime="99.0")).number)
    store.activate(store.generation(numbers[0]))
    store.mark_good(store.generation(numbers[0]))
    return numbers


def swap_often(store: Store, numbers: list[int], swaps: int, listener: Listener, pid: int) -> int:
    """Exchange the maps so many times; return how many times that was refused."""
    refused = 0
    for count in range(1, swaps + 1):
        number = numbers[count % len(numbers)]
        (store.root / "outcome.json").unlink(missing_ok=True)
        with store.locked():
            store.link("wanted", number)
        while (outcome := store.outcome()) is None:
            resident_mb(pid)  # raises where the run has ended
            time.sleep(0.02)
        if not outcome.ok:
            refused += 1
            print(f"swap {count}: {outcome.text}")
        if count in (1, 10, 30, 100) or count % 200 == 0 or count == swaps:
            files = len(list(Path(f"/proc/{pid}/fd").iterdir()))
            threads = len(list(Path(f"/proc/{pid}/task").iterdir()))
            lost = 1.0 - listener.poses / max(listener.frames, 1)
            print(
                f"{count:6} {resident_mb(pid):9.1f} {files:6} {threads:8} {listener.frames:8} "
                f"{100 * lost:10.2f} {listener.worst.ms:10.0f} {listener.worst.frames:8}",
                flush=True,
            )
    return refused


def main() -> int:
    """Print the table; 1 if the run did not end well."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("maps", type=Path, nargs=2)
    parser.add_argument("--swaps", type=int, default=1000)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        store = Store(work / "store")
        numbers = install(store, arguments.maps, work)
        config = work / "mapvo.toml"
        text = CONFIG.format(
            recording=arguments.recording.resolve(), store=store.root, endpoint=work / "poses"
        )
        config.write_text(text)
        run = subprocess.Popen([sys.executable, "-m", "edge.cli", "run", "--config", str(config)])
        listener = Listener(str(work / "poses"))
        try:
            while listener.poses < 30 and run.poll() is None:
                time.sleep(0.1)
            listener.forget()
            print(" swaps    rss_mb  files  threads   frames  no pose %  longest ms   frames")
            refused = swap_often(store, numbers, arguments.swaps, listener, run.pid)
        finally:
            run.send_signal(signal.SIGTERM)
            status = run.wait(60)
            listener.stop()
        print(f"{refused} refused; the run ended with status {status}")
        print(msgspec.json.encode(store.outcome()).decode())
    return int(status != 0)


if __name__ == "__main__":
    sys.exit(main())
