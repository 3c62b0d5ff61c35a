# SPDX-License-Identifier: Apache-2.0
import os
import signal
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.errors import OutputError, RecordingError
from maps.scale import onto_poses
from maps.sfm import solve as solving
from maps.sfm.job import Job, Photo
from maps.sfm.solve import SfmResult, solve
from tests.maps.posters import CAMERA, path, picture, posters, write_posters

N = 7


def job_of(*roots: Path, n: int = N) -> Job:
    photos = [Photo(str(root), i, 0) for root in roots for i in range(n)]
    pairs = [(i, j) for i in range(len(photos)) for j in range(i + 1, len(photos))]
    return Job(photos=photos, cameras=[CAMERA], pairs=pairs, refine_lens=True, threads=1)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_posters(tmp_path_factory.mktemp("walks") / "walk", N)


@pytest.fixture(scope="module")
def solved(walk: Path) -> SfmResult:
    return solve(job_of(walk))


@pytest.mark.slow
def test_poses_are_those_of_the_walk_in_a_unit_of_their_own(solved: SfmResult) -> None:
    assert solved.photo.tolist() == list(range(N))
    T_true = list(path(N))
    S = onto_poses(list(solved.T_world_cam), T_true)
    for T, truth in zip(solved.T_world_cam, T_true, strict=True):
        assert np.linalg.norm(S.s * S.R @ T[:3, 3] + S.t - truth[:3, 3]) < 0.006  # m
        turn = (S.R @ T[:3, :3]).T @ truth[:3, :3]
        assert np.trace(turn) > 1.0 + 2.0 * np.cos(np.deg2rad(0.15))
    assert solved.k1.tolist() == [0.0]  # seven images are too few to believe a lens


@pytest.mark.slow
def test_a_lens_that_the_calibration_does_not_know_is_found(tmp_path: Path) -> None:
    root = write_posters(tmp_path / "bent", 11, k1=-0.08)
    found = solve(job_of(root, n=11))
    assert found.k1 == pytest.approx([-0.08], abs=0.02)  # other walks: to 0.005
    S = onto_poses(list(found.T_world_cam), list(path(11)))
    centres = S.s * found.T_world_cam[:, :3, 3] @ S.R.T + S.t
    assert np.linalg.norm(centres - path(11)[:, :3, 3], axis=1).max() < 0.008  # m


@pytest.mark.slow
def test_sightings_have_the_depths_of_what_they_show(solved: SfmResult) -> None:
    S = onto_poses(list(solved.T_world_cam), list(path(N)))
    for i, T in enumerate(path(N)):
        begin, end = solved.offsets[i : i + 2]
        _, depth = picture(posters(), T)
        u, v = np.round(solved.pixels[begin:end]).astype(int).T
        off = S.s * solved.depth[begin:end] / depth[v, u] - 1.0
        assert end - begin > 50
        assert np.median(np.abs(off)) < 0.006


@pytest.mark.slow
def test_images_of_two_places_are_refused_by_name(walk: Path, tmp_path: Path) -> None:
    other = write_posters(tmp_path / "other", 5, seed=8)
    for i in range(5):  # the marker would join them
        image = cv2.imread(str(other / "rgb" / f"{i:04d}.png"), cv2.IMREAD_GRAYSCALE)
        image[60:140, 100:210] = 128
        cv2.imwrite(str(other / "rgb" / f"{i:04d}.png"), image)
    job = job_of(walk, n=5)
    photos = job.photos + [Photo(str(other), i, 0) for i in range(5)]
    pairs = [(i, j) for i in range(len(photos)) for j in range(i + 1, len(photos))]
    both = Job(photos=photos, cameras=[CAMERA], pairs=pairs, refine_lens=False, threads=1)
    with pytest.raises(RecordingError, match=r"2 groups .*5 of walk 0 to 4; 5 of other 0 to 4"):
        solve(both)


@pytest.mark.slow
def test_images_that_show_nothing_are_refused(tmp_path: Path) -> None:
    root = write_posters(tmp_path / "blank", 3)
    for i in range(3):
        cv2.imwrite(str(root / "rgb" / f"{i:04d}.png"), np.full((240, 320), 80, np.uint8))
    with pytest.raises(RecordingError, match="no two of the 3 images"):
        solve(job_of(root, n=3))


@pytest.mark.slow
def test_an_image_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    root = write_posters(tmp_path / "cut", 3)
    (root / "rgb" / "0001.png").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"0001\.png: is empty; .*--exclude 1"):
        solve(job_of(root, n=3))


@pytest.mark.slow
def test_a_full_disk_is_said(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solving.tempfile, "tempdir", "/proc")
    with pytest.raises(OutputError, match="/proc"):
        solve(job_of(walk))


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("import os; os.abort()", "SIGABRT"),
        ("import os; os.write(2, b'check failed: x'); os.abort()", "check failed: x"),
        ("raise ZeroDivisionError('odd')", "status 1.*odd"),
        ("print('error a.bin: is odd; mend it'); raise SystemExit(2)", "^a.bin: is odd; mend it$"),
    ],
)
def test_a_process_that_ends_badly_is_one_line(
    walk: Path, monkeypatch: pytest.MonkeyPatch, program: str, said: str
) -> None:
    monkeypatch.setattr(solving, "COMMAND", ("-c", program))
    with pytest.raises(RecordingError, match=said) as refused:
        solve(job_of(walk))
    assert "\n" not in str(refused.value)


def test_the_process_ends_with_the_one_that_waits_for_it(
    walk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Enough(BaseException):
        pass

    program = "import os, time; print('features', os.getpid(), 9, flush=True); time.sleep(60)"
    monkeypatch.setattr(solving, "COMMAND", ("-c", program))
    seen: list[int] = []

    def follow(lines: object) -> None:
        seen.append(int(next(lines).split()[1]))  # type: ignore[call-overload]
        raise Enough

    monkeypatch.setattr(solving, "_follow", follow)
    with pytest.raises(Enough):
        solve(job_of(walk))
    with pytest.raises(ProcessLookupError):
        os.kill(seen[0], signal.SIGTERM)


def test_its_words_are_followed_through_all_stages() -> None:
    lines = ["features 1 2", "features 2 2", "matches 50 50", "poses 1 2"]
    assert solving._follow(iter(f"{line}\n" for line in lines)) is None
    assert solving._follow(iter([*lines, "error x: why\n"])) == "x: why"


def test_what_the_process_leaves_among_temporary_files_goes_with_it(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = "import sys, tempfile; tempfile.mkstemp(); print('error', tempfile.gettempdir())"
    monkeypatch.setattr(solving, "COMMAND", ("-c", program))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(RecordingError, match=str(tmp_path)):
        solve(job_of(walk))
    assert list(tmp_path.iterdir()) == []
