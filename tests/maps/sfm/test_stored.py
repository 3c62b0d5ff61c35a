# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.errors import OutputError, RecordingError
from maps.sfm.job import Job, Photo
from maps.sfm.solve import SfmResult
from maps.sfm.stored import identity, load, save
from tests.maps.posters import CAMERA, write_posters

RESULT = SfmResult(
    photo=np.array([0, 2], np.int64),
    T_world_cam=np.array([np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])]) + 0.1,
    k1=np.array([0.1]),
    offsets=np.array([0, 1, 1], np.int64),
    pixels=np.array([[3.25, 4.5]], np.float32),
    depth=np.array([2.5], np.float32),
)


@pytest.fixture
def job(tmp_path: Path) -> Job:
    root = str(write_posters(tmp_path / "walk", 3))
    photos = [Photo(root, i, 0) for i in range(3)]
    return Job(photos=photos, cameras=[CAMERA], pairs=[(0, 1)], refine_lens=True, threads=1)


def test_what_was_found_comes_back_bit_by_bit(job: Job, tmp_path: Path) -> None:
    path = tmp_path / "kept" / "walk.sfm"
    assert load(path, job) is None
    save(path, job, RESULT)
    found = load(path, job)
    assert found is not None
    for there, here in zip(RESULT, found, strict=True):
        assert there.dtype == here.dtype
        np.testing.assert_array_equal(there, here)
    assert [file.name for file in path.parent.iterdir()] == ["walk.sfm"]


def test_it_is_of_images_and_cameras_not_of_how_it_was_found(job: Job, tmp_path: Path) -> None:
    same = msgspec.structs.replace(job, pairs=[], threads=4)
    assert identity(same) == identity(job)
    camera = msgspec.structs.replace(job, refine_lens=False)
    fewer = msgspec.structs.replace(job, photos=job.photos[:2])
    assert len({identity(job), identity(camera), identity(fewer)}) == 3
    path = tmp_path / "walk.sfm"
    save(path, job, RESULT)
    image = Path(job.photos[0].root) / "rgb" / "0001.png"
    image.write_bytes(image.read_bytes() + b"\0")
    with pytest.raises(RecordingError, match=r"walk\.sfm: holds the poses of other images"):
        load(path, job)


def test_a_walk_that_was_moved_is_the_same(job: Job, tmp_path: Path) -> None:
    before = identity(job)
    moved = Path(job.photos[0].root).rename(tmp_path / "elsewhere")
    photos = [photo._replace(root=str(moved)) for photo in job.photos]
    assert identity(msgspec.structs.replace(job, photos=photos)) == before


@pytest.mark.parametrize("data", [b"", b"no tile at all", b"\x08" + b"\0" * 7 + b"{}      "])
def test_other_files_are_refused(job: Job, tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "walk.sfm"
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"walk\.sfm: holds no poses"):
        load(path, job)


def test_a_file_cut_short_is_refused(job: Job, tmp_path: Path) -> None:
    path = tmp_path / "walk.sfm"
    save(path, job, RESULT)
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(RecordingError, match=r"walk\.sfm"):
            load(path, job)


def test_a_place_that_cannot_be_written_to_is_named(job: Job) -> None:
    with pytest.raises(OutputError, match=r"/proc/walk\.sfm"):
        save(Path("/proc/walk.sfm"), job, RESULT)
    with pytest.raises(RecordingError, match="/proc: cannot be read"):
        load(Path("/proc"), job)
