# SPDX-License-Identifier: Apache-2.0
"""`mapvo` as its users run it, with good and bad input."""

import json
import os
import resource
import shutil
import signal
import subprocess
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import zmq

from edge.outputs import wire
from edge.outputs.run_folder import is_run_folder
from edge.runtime.run_data import read_run, read_truth
from tests.world.command import TIMEOUT_S, assert_refused, command, mapvo
from tests.world.conftest import World

pytestmark = [pytest.mark.world, pytest.mark.slow]


@pytest.fixture
def drive(world: World, tmp_path: Path) -> Path:
    """The first 12 frames of the query drive, to be spoiled."""
    folder = tmp_path / "drive"
    (folder / "rgb").mkdir(parents=True)
    lines = (world.query / "rgb.txt").read_text().splitlines(keepends=True)
    rows = [line for line in lines if not line.startswith("#")][:12]
    (folder / "rgb.txt").write_text("".join(rows))
    for row in rows:
        shutil.copy(world.query / row.split()[1], folder / row.split()[1])
    shutil.copy(world.query / "camera.toml", folder)
    return folder


def slow_from(index: int, recording: Path, folder: Path) -> Path:
    """The same images in the same place, but from `index` on, one every minute."""
    for name in ("rgb", "camera.toml"):
        (folder / name).symlink_to(recording / name)
    lines = (recording / "rgb.txt").read_text().splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    start_s = float(rows[index][0])
    for number, row in enumerate(rows[index:]):
        row[0] = f"{start_s + 60.0 * number:.6f}"
    (folder / "rgb.txt").write_text("".join(f"{t} {path}\n" for t, path in rows))
    return folder


def images(drive: Path) -> list[Path]:
    return sorted((drive / "rgb").iterdir())


def test_realtime_run_is_heard_while_it_runs(world: World, tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/poses"
    (tmp_path / "site.toml").write_text(f'[outputs.zmq]\nendpoint = "{endpoint}"\n')
    context = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.connect(endpoint)
    socket.subscribe("")
    arguments = ("replay", world.query, "--map", world.map, "--realtime", "--out", tmp_path / "run")
    heard: dict[str, list[wire.Message]] = {topic: [] for topic in wire.TOPICS}
    with subprocess.Popen(command(*arguments, "--config", tmp_path / "site.toml")) as process:
        while process.poll() is None or socket.poll(0):
            if socket.poll(50):
                topic, message = wire.decode(socket.recv())
                heard[topic].append(message)
    socket.close(linger=0)
    context.term()

    assert process.returncode == 0
    data = read_run(tmp_path / "run")
    assert len(data.t_ns) + data.stats["dropped_frames"] == 100
    assert data.stats["wall_s"] > 4.5  # 100 frames at 20 Hz
    counts = {"pose": "published", "fix": "fixes_tried"}
    for topic, count in counts.items():  # all from the first one heard on
        numbers = [message.seq for message in heard[topic]]
        assert numbers == list(range(numbers[0], data.stats[count]))
    assert heard["status"]
    truth = read_truth(world.query)
    last = heard["pose"][-1]
    assert isinstance(last, wire.PoseMessage)
    assert last.map == world.map.name
    T_true = truth.pose_at(last.t_ns)
    assert T_true is not None
    place = np.array([last.T_map_cam.x, last.T_map_cam.y, last.T_map_cam.z])
    assert np.linalg.norm(place - T_true[:3, 3]) < 0.2  # frames may have been overtaken


def test_nothing_is_compiled_after_warm_up(world: World, tmp_path: Path) -> None:
    result = mapvo("replay", world.query, "--map", world.map, "--out", tmp_path / "run")
    assert result.returncode == 0, result.stderr
    assert "compiled_late" not in result.stderr
    realtime = mapvo(
        "replay", world.query, "--map", world.map, "--out", tmp_path / "run", "--realtime"
    )
    assert realtime.returncode == 0, realtime.stderr
    assert "compiled_late" not in realtime.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_run_is_whole(
    world: World, tmp_path_factory: pytest.TempPathFactory, number: signal.Signals
) -> None:
    tmp_path = tmp_path_factory.mktemp("interrupted")
    out = tmp_path / "run"
    slow = slow_from(40, world.query, tmp_path_factory.mktemp("slow"))
    arguments = ("replay", slow, "--map", world.map, "--realtime", "--out", out)
    with subprocess.Popen(
        command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        while process.poll() is None and not any(
            file.stat().st_size > 1000 for file in tmp_path.glob(".run.part-*/frames.csv")
        ):
            time.sleep(0.05)
        process.send_signal(number)
        _, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert is_run_folder(out)
    data = read_run(out)
    assert 0 < len(data.t_ns) < 100
    assert data.stats["interrupted"]
    assert [file.name for file in tmp_path.iterdir()] == ["run"]


def test_interrupted_start_leaves_nothing(
    world: World, tmp_path_factory: pytest.TempPathFactory
) -> None:
    tmp_path = tmp_path_factory.mktemp("interrupted")
    slow = slow_from(40, world.query, tmp_path_factory.mktemp("slow"))
    arguments = ("replay", slow, "--map", world.map, "--realtime", "--out", tmp_path / "run")
    with subprocess.Popen(command(*arguments), stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None and not list(tmp_path.glob(".run.part-*")):
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 130
    if (tmp_path / "run").exists():  # this process slept until the play had begun
        assert read_run(tmp_path / "run").stats["interrupted"]
    else:
        assert errors == "mapvo: interrupted\n"
        assert list(tmp_path.iterdir()) == []


def test_full_disk_is_one_line(world: World, tmp_path: Path) -> None:
    def limit_file_size() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))

    result = subprocess.run(
        command("replay", world.query, "--out", tmp_path / "run"),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        preexec_fn=limit_file_size,
    )
    assert_refused(result, str(tmp_path / "run"), "cannot be written")
    assert list(tmp_path.iterdir()) == []


def test_folder_that_is_no_map_is_one_line(world: World, tmp_path: Path) -> None:
    for command_line in (
        ("replay", world.query, "--map", world.query, "--out", tmp_path / "run"),
        (
            "localise",
            world.query,
            *images(world.query)[:1],
            "--camera",
            world.query / "camera.toml",
        ),
    ):
        assert_refused(mapvo(*command_line), str(world.query), "no map")
    assert list(tmp_path.iterdir()) == []


def test_truncated_tile_is_one_line(world: World, tmp_path: Path) -> None:
    shutil.copytree(world.map, tmp_path / "map")
    (tile,) = (tmp_path / "map").rglob("*.tile")
    tile.write_bytes(tile.read_bytes()[:-1000])
    result = mapvo("replay", world.query, "--map", tmp_path / "map", "--out", tmp_path / "run")
    assert_refused(result, tile.name)
    assert not (tmp_path / "run").exists()


def test_missing_and_broken_images_are_told_and_left_out(drive: Path, tmp_path: Path) -> None:
    files = images(drive)
    files[3].unlink()
    files[5].write_bytes(files[5].read_bytes()[:500])
    cv2.imwrite(str(files[7]), np.zeros((10, 10), np.uint8))
    result = mapvo("replay", drive, "--out", tmp_path / "run")
    assert result.returncode == 0, result.stderr
    assert len(result.stderr.splitlines()) == 3
    for file in (files[3], files[5], files[7]):
        assert file.name in result.stderr
    data = read_run(tmp_path / "run")
    assert len(data.t_ns) == 9
    assert data.stats["dropped_frames"] == 3


def test_recording_without_images_is_refused(drive: Path, tmp_path: Path) -> None:
    for file in images(drive):
        file.unlink()
    result = mapvo("replay", drive, "--out", tmp_path / "run")
    assert_refused(result, str(drive), "is missing")
    assert not (tmp_path / "run").exists()


def test_black_frames_are_survived_in_silence(world: World, drive: Path, tmp_path: Path) -> None:
    for file in images(drive):
        cv2.imwrite(str(file), np.zeros((240, 320), np.uint8))
    result = mapvo("replay", drive, "--map", world.map, "--out", tmp_path / "run")
    assert result.returncode == 0, result.stderr
    assert "no map pose: few features" in result.stdout
    data = read_run(tmp_path / "run")
    assert set(data.states) == {"waiting"}
    assert data.stats["published"] == 0


def test_single_images_are_found(world: World, tmp_path: Path) -> None:
    chosen = images(world.query)[30:90:20]
    camera = world.query / "camera.toml"
    result = mapvo("localise", world.map, *chosen, "--camera", camera)
    assert result.returncode == 0, result.stderr
    fixes = [json.loads(line) for line in result.stdout.splitlines()]
    assert [fix["image"] for fix in fixes] == list(map(str, chosen))
    truth = read_truth(world.query)
    found = [
        (fix, index) for fix, index in zip(fixes, (30, 50, 70), strict=True) if fix["accepted"]
    ]
    assert len(found) >= 2
    for fix, index in found:
        T_true = truth.T_world_cam[index]
        assert np.linalg.norm(np.array(fix["T_map_cam"])[:3, 3] - T_true[:3, 3]) < 0.05

    out = tmp_path / "fixes.jsonl"
    assert mapvo("localise", world.map, *chosen, "--camera", camera, "--out", out).returncode == 0
    written = [json.loads(line) for line in out.read_text().splitlines()]
    assert [fix["T_map_cam"] for fix in written] == [fix["T_map_cam"] for fix in fixes]


def test_ctrl_c_keeps_the_images_that_were_found(world: World, tmp_path: Path) -> None:
    first, second, third = images(world.query)[30:90:20]
    pipe, out = tmp_path / "pipe.jpg", tmp_path / "fixes.jsonl"
    os.mkfifo(pipe)
    camera = world.query / "camera.toml"
    words = ("localise", world.map, first, pipe, third, "--camera", camera, "--out", out)
    with subprocess.Popen(command(*words), stdout=subprocess.PIPE, text=True) as process:
        with pipe.open("wb") as file:  # once the second image is asked for
            process.send_signal(signal.SIGINT)
            file.write(second.read_bytes())
        said, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 130
    assert "2 images" in said
    written = [json.loads(line)["image"] for line in out.read_text().splitlines()]
    assert written == [str(first), str(pipe)]


def test_missing_image_to_localise_is_one_line(world: World, tmp_path: Path) -> None:
    result = mapvo(
        "localise",
        world.map,
        "none.jpg",
        "--camera",
        world.query / "camera.toml",
        "--out",
        tmp_path / "fixes.jsonl",
    )
    assert_refused(result, "none.jpg", "missing")
    assert list(tmp_path.iterdir()) == []


def test_run_is_drawn_with_map_and_truth(world: World, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert mapvo("replay", world.query, "--map", world.map, "--out", run).returncode == 0
    result = mapvo("plot", run, "--map", world.map, "--truth", world.query)
    assert result.returncode == 0, result.stderr
    assert result.stdout == f"{run / 'plot.png'}\n"
    assert cv2.imread(str(run / "plot.png")) is not None
