# SPDX-License-Identifier: Apache-2.0
"""At whatever moment the power goes, the store holds the old or the new generation, whole.

The disk below ext4 is recorded: every block written, every flush, in order. Then the power is
cut at 200 moments: what was flushed before is there, of what was written since a random part.
"""

import os
import random
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from edge.errors import EdgeError
from edge.store.store import Store
from tests.edge.store.block_server import FLUSH, MARK, WRITE, Entry, read_log
from tests.edge.store.made_bundles import RUNTIME, Workstation
from tests.edge.store.power_cut_work import FILES_IN_FOLDER, State, parse, prepare

ROOT = Path(__file__).parents[3]
HERE = Path(__file__).parent
IMAGE_BYTES = 16 << 20
PAGE = 4096
MOMENTS = 200
MOUNT_OPTIONS = "noauto_da_alloc,nodev,nosuid"


def why_impossible() -> str | None:
    if os.geteuid() != 0:
        return "needs root, to mount disks"
    for program in ("mkfs.ext4", "losetup", "mount"):
        if shutil.which(program) is None:
            return f"needs {program}"
    for device in ("/dev/fuse", "/dev/loop-control"):
        if not Path(device).exists():
            return f"needs {device}"
    if subprocess.run(["losetup", "--find"], check=False, capture_output=True).returncode != 0:
        return "needs a free loop device"
    if " ext4\n" not in Path("/proc/filesystems").read_text().replace("\t", " "):
        return "needs ext4 in the kernel"
    return None


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(why_impossible() is not None, reason=why_impossible() or ""),
]


def run(*command: str | Path) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@contextmanager
def mounted(file: Path, folder: Path) -> Iterator[Path]:
    """Mount an image; the loop device goes with the mount."""
    folder.mkdir(exist_ok=True)
    run("mount", "-t", "ext4", "-o", f"loop,{MOUNT_OPTIONS}", file, folder)
    try:
        yield folder
    finally:
        run("umount", folder)


@contextmanager
def watched(image: Path, work: Path) -> Iterator[tuple[Path, "subprocess.Popen[str]"]]:
    """Mount an image through the block server: the folder, and where marks are noted."""
    disk = work / "disk"
    disk.touch()
    command = [sys.executable, str(HERE / "block_server.py"), image, disk, work / "log"]
    server = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )
    assert server.stdin is not None
    assert server.stdout is not None
    try:
        assert server.stdout.readline() == "ready\n"
        with mounted(disk, work / "watched") as folder:
            yield folder, server
        run("umount", disk)
    finally:
        server.stdin.close()
        server.wait(300)
        server.stdout.close()


@pytest.fixture(scope="module")
def start(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Workstation]:
    """A disk with generation 1 in its store, and bundles of generations 2 to 4."""
    work = tmp_path_factory.mktemp("power")
    bench = Workstation(work / "bench")
    bundles = [bench.bundle(version) for version in (1, 2, 3, 4)]
    image = work / "image"
    with image.open("wb") as file:
        file.truncate(IMAGE_BYTES)
    now = "lazy_itable_init=0,lazy_journal_init=0"
    run("mkfs.ext4", "-q", "-F", "-b", str(PAGE), "-J", "size=4", "-E", now, image)
    try:
        with mounted(image, work / "first") as folder:
            prepare(folder, bundles[0], bench.keys)
    except subprocess.CalledProcessError as error:
        pytest.skip(f"cannot mount here: {error.stderr.strip()}")
    return image, bench


def record(start: tuple[Path, Workstation], work: Path, without: str | None) -> list[Entry]:
    """Everything that reached the disk while the work was done; the disk then stopped."""
    image, bench = start
    with watched(image, work) as (folder, server):
        assert server.stdin is not None
        assert server.stdout is not None
        module = ["-m", "tests.edge.store.power_cut_work", folder, bench.folder]
        worker = subprocess.Popen(
            [sys.executable, *map(str, module), *([without] if without else [])],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        assert worker.stdin is not None
        assert worker.stdout is not None
        with worker:
            for line in worker.stdout:
                server.stdin.write(line)
                assert server.stdout.readline() == "noted\n"
                worker.stdin.write("\n")
        assert worker.returncode == 0
        server.stdin.write("end\n")
        assert server.stdout.readline() == "noted\n"
    entries = read_log(work / "log")
    end = entries.index(Entry(MARK, 0, b"end"))
    return entries[:end]  # what unmounting wrote is none of the store's merits


def states(entries: list[Entry]) -> tuple[list[State], list[int]]:
    """States in their order, and how many entries came before each was reached."""
    reached, places = [State(1, 1, 1, frozenset({1}))], [0]
    for place, entry in enumerate(entries):
        if entry.kind == MARK:
            reached.append(parse(entry.data.decode()))
            places.append(place)
    return reached, places


def cut(image: bytes, entries: list[Entry], moment: int, rng: random.Random) -> bytearray:
    """The disk after a power cut before entry `moment`."""
    disk = bytearray(image)
    flushes = [place for place in range(moment) if entries[place].kind == FLUSH]
    safe = flushes[-1] if flushes else 0
    share = rng.choice((0.0, 0.2, 0.5, 0.8, 1.0))
    for place in range(moment):
        entry = entries[place]
        if entry.kind != WRITE:
            continue
        for at in range(0, len(entry.data), PAGE):
            if place < safe or rng.random() < share:
                piece = entry.data[at : at + PAGE]
                disk[entry.offset + at : entry.offset + at + len(piece)] = piece
    return disk


def problem(folder: Path, before: State, after: State) -> str | None:
    """What is wrong with a disk that was cut on the way between two states."""
    store = Store(folder / "store")
    for name in ("current", "good"):
        number = store.linked(name)
        if number not in (getattr(before, name), getattr(after, name)):
            return f"{name} is {number}"
    try:
        for generation in map(store.generation, store.numbers()):
            store.verify(generation)
        store.trial()
        present = set(store.numbers())
        for lost in (before.installed & after.installed) - present:
            return f"generation {lost} is lost"
        store.collect()
    except EdgeError as error:
        return str(error)
    contents = {(folder / "folder" / str(name)).read_bytes() for name in range(FILES_IN_FOLDER)}
    allowed = [f"{state.folder}".encode() * 5000 for state in (before, after)]
    return None if len(contents) == 1 and contents <= set(allowed) else "the folder is torn"


def problems(
    start: tuple[Path, Workstation], work: Path, without: str | None = None
) -> Iterator[str]:
    """What is wrong after power cuts, if anything."""
    entries = record(start, work, without)
    image = start[0].read_bytes()
    reached, places = states(entries)
    rng = random.Random(5)
    # Right after a step has said that it is done, nothing of it may hang in the air.
    moments = [place + 1 for place in places[1:]]
    moments += [rng.randrange(len(entries) + 1) for _ in range(MOMENTS - len(moments))]
    for moment in moments:
        step = max(i for i, place in enumerate(places) if place <= moment - 1 or i == 0)
        after = reached[min(step + 1, len(reached) - 1)]
        disk = work / "cut"
        disk.write_bytes(cut(image, entries, moment, rng))
        with mounted(disk, work / "after") as folder:
            try:
                wrong = problem(folder, reached[step], after)
            except OSError as error:
                wrong = str(error)
        if wrong:
            yield f"before entry {moment} of {len(entries)}, after step {step}: {wrong}"


def test_any_power_cut_leaves_the_old_or_the_new_generation(
    start: tuple[Path, Workstation], tmp_path: Path
) -> None:
    assert list(problems(start, tmp_path)) == []


@pytest.mark.parametrize("without", ["file", "folder"])
def test_the_test_notices_when_syncs_are_left_out(
    start: tuple[Path, Workstation], tmp_path: Path, without: str
) -> None:
    assert next(problems(start, tmp_path, without), None) is not None


def test_an_interrupted_installation_can_be_done_again(
    start: tuple[Path, Workstation], tmp_path: Path
) -> None:
    entries = record(start, tmp_path, None)
    image, bench = start
    first_mark = next(place for place, entry in enumerate(entries) if entry.kind == MARK)
    rng = random.Random(2)
    for moment in rng.sample(range(first_mark), 5):
        disk = tmp_path / "cut"
        disk.write_bytes(cut(image.read_bytes(), entries, moment, rng))
        with (
            mounted(disk, tmp_path / "again") as folder,
            bench.open(bench.folder / "hall-2.mapbundle") as bundle,
        ):
            store = Store(folder / "store")
            generation = store.install(bundle, RUNTIME)
            store.verify(generation)
            assert generation.map_version == 2
