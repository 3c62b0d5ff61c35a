# SPDX-License-Identifier: Apache-2.0
"""Runs `mapvo replay --realtime`, listens to its pose stream, and says how good it was."""

import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import zmq

from edge.config import Config
from edge.outputs import wire
from edge.runtime.run_data import errors_against, read_run, read_truth

REFRESH_S = 0.1


def main(sequence: Path, map_folder: Path, run: Path) -> int:
    """Play `sequence` on the map; return the exit status."""
    command = ["mapvo", "replay", sequence, "--map", map_folder, "--realtime", "--out", run]
    with subprocess.Popen(command) as replay:
        last = listen(replay)
    if replay.returncode != 0:
        return replay.returncode
    if last is None:
        print("no pose was published", file=sys.stderr)
        return 1
    print("\nthe live stream's last pose message (topic `pose`, here as JSON):")
    print(msgspec.json.encode(last).decode())

    data = read_run(run)
    errors = errors_against(read_truth(sequence), data.poses)
    middle, most = np.percentile(errors.position_m, (50, 95)) * 100.0
    print(
        f"\n{len(data.poses.t_ns)} of {len(data.t_ns)} frames had a map pose; "
        f"error against the exact truth: median {middle:.2f} cm and "
        f"{np.median(errors.rotation_deg):.2f} degrees, 95 % below {most:.2f} cm"
    )
    latency = data.stats["ms"]["latency"]
    print(
        f"from image to pose: median {latency['median']:.1f} ms, 99 % below {latency['p99']:.1f} ms"
    )
    subprocess.run(
        ["mapvo", "plot", run, "--map", map_folder, "--truth", sequence],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    print(f"picture: {run / 'plot.png'}")
    return 0


def listen(replay: "subprocess.Popen[bytes]") -> wire.PoseMessage | None:
    """Take in poses until the replay ends; return the last."""
    context = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.connect(Config().outputs.zmq.endpoint)
    socket.subscribe("pose ")
    last, shown_s = None, 0.0
    while replay.poll() is None or socket.poll(0):
        if not socket.poll(50):
            continue
        message = wire.decode(socket.recv())[1]
        if isinstance(message, wire.PoseMessage):
            last = message
            if sys.stderr.isatty() and time.monotonic() - shown_s > REFRESH_S:
                shown_s = time.monotonic()
                T = message.T_map_cam
                place = f"x {T.x:7.3f}  y {T.y:7.3f}  z {T.z:7.3f} m"
                print(f"\r   {place}  ± {message.sigma_m * 100:.1f} cm ", end="", file=sys.stderr)
    socket.close(linger=0)
    context.term()
    return last


if __name__ == "__main__":
    sys.exit(main(*map(Path, sys.argv[1:])))
