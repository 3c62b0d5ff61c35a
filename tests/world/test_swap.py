# SPDX-License-Identifier: Apache-2.0
"""Maps exchanged under a running pipeline in a simulated room."""

import shutil
import time
from functools import partial
from pathlib import Path
from threading import Thread

import msgspec
import pytest

from edge.cameras.recording import open_recording
from edge.config import Config
from edge.errors import EdgeError
from edge.geometry.camera import CameraModel
from edge.odometry.odometry import Odometry
from edge.relocalise.relocaliser import Relocaliser
from edge.runtime.keyframe_worker import InlineKeyframeWorker, KeyframeTimes
from edge.runtime.live import OpenedMap, Tracking
from edge.runtime.search import DelayedSearch
from edge.runtime.swap_rehearsal import RehearsedSwitch, RehearsingStages
from edge.runtime.swap_selftest import check_held_out, choose_held_out, find_held_out
from edge.runtime.warm_up import MAP_FOLDER
from edge.store.bundle import HeldOut
from edge.tiles.manifest import FILE_NAME, camera_entry, encode
from edge.tiles.reader import open_map, read_manifest
from edge.types import Frame
from tests.world.conftest import World

pytestmark = [pytest.mark.world, pytest.mark.slow]
SWAPS = 3
MOST_FRAMES = 4000


class _Inline(InlineKeyframeWorker):
    """Keyframe work within the step, so that no machine is too slow for this test."""

    def close(self) -> None:
        """Nothing to end."""

    abandon = close


class Stages(RehearsingStages):
    """The live stages without threads."""

    def _make_tracking(self, camera: CameraModel) -> Tracking:
        times = KeyframeTimes(time.thread_time_ns, inline=True)
        worker = _Inline(1, times)
        self.lens = camera  # of the newest odometry
        odometry = Odometry(camera, self._odometry_config, worker)
        return Tracking(odometry, worker, times)  # type: ignore[arg-type]


def open_inline(folder: Path, config: Config, camera: CameraModel) -> OpenedMap:
    map_ = open_map(folder)
    camera = map_.camera_for(camera)
    search = DelayedSearch(Relocaliser(map_, camera, config.relocalise), 3, time.thread_time_ns)
    return OpenedMap(map_, search, camera)


class Drive:
    """The query drive forth and back, again and again, through stages that can be swapped."""

    def __init__(self, world: World, config: Config) -> None:
        recording = open_recording(world.query)
        self._images = [frame.image for frame in recording]
        self._period_ns = int(1e9 / recording.rate_hz)
        opener = partial(open_inline, config=config, camera=recording.camera)
        self.stages = Stages(config, recording.camera, opener(world.map))
        self.switch = RehearsedSwitch(opener, self.stages, config.tiles)
        self.switch._timeout_s = 3600.0  # of a clock on the wall; frames have their own
        self.frame = 0
        self.resets: list[int] = []
        self.odom_ids: list[int] = []  # each as it came
        self.silent = 0  # frames without a pose since the first

    def step(self) -> bool:
        """One frame; whether it has a pose."""
        turn = len(self._images) - 1
        place = abs((self.frame + turn) % (2 * turn) - turn)
        image = self._images[place]
        report = self.stages.step(Frame(self.frame, self.frame * self._period_ns, image))
        self.switch.apply(self.stages.use_map)
        self.frame += 1
        if report.update.odom_id not in self.odom_ids[-1:]:
            self.odom_ids.append(report.update.odom_id)
        if report.pose is None:
            self.silent += bool(self.resets)
            return False
        if not self.resets or self.resets[-1] != report.pose.reset_counter:
            self.resets.append(report.pose.reset_counter)
        return True

    def swap(self, folder: Path) -> EdgeError | None:
        """Drive on until the exchange is decided; return why it was refused, if it was.

        Frames wait while the map is opened, so that each run of this is like the last.
        """
        refusals: list[EdgeError] = []

        def ask() -> None:
            try:
                self.switch.swap(folder)
            except EdgeError as error:
                refusals.append(error)

        asking = Thread(target=ask)
        asking.start()
        while asking.is_alive() and self.switch._waiting is None:
            time.sleep(0.001)
        while self.switch._waiting is not None:
            assert self.frame < MOST_FRAMES
            self.step()
        asking.join()
        return refusals[0] if refusals else None


def test_swaps_leave_no_frame_without_a_pose(world: World, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(world.map, other)
    drive = Drive(world, Config())
    while not drive.step():
        assert drive.frame < MOST_FRAMES
    for number in range(SWAPS):
        folder = (other, world.map)[number % 2]
        assert drive.swap(folder) is None
        assert drive.stages.map is not None
        assert drive.stages.map.folder == folder
        assert all(drive.step() for _ in range(10))
    assert len(drive.resets) >= SWAPS + 1
    assert drive.resets == sorted(set(drive.resets))
    drive.stages.close()


def with_other_lens(map_folder: Path, out: Path) -> Path:
    """A copy of a map that reads images of its camera by another lens."""
    shutil.copytree(map_folder, out)
    manifest = read_manifest(out)
    given = manifest.cameras[0]
    bent = msgspec.structs.replace(given, distortion_model="radtan", distortion=[0.004, 0, 0, 0])
    entry = msgspec.structs.replace(camera_entry(bent.model()), replaces=given.id)
    (out / FILE_NAME).write_bytes(encode(msgspec.structs.replace(manifest, cameras=[entry])))
    return out


def test_with_a_maps_lens_comes_an_odometry_that_sees_through_it(
    world: World, tmp_path: Path
) -> None:
    bent = with_other_lens(world.map, tmp_path / "bent")
    drive = Drive(world, Config())
    given = drive.stages.lens
    while not drive.step():
        assert drive.frame < MOST_FRAMES
    before = len(drive.odom_ids)
    for number, (folder, lens) in enumerate(((bent, (0.004, 0.0, 0.0, 0.0)), (world.map, ()))):
        assert drive.swap(folder) is None
        drive.step()
        assert drive.stages.lens.distortion == lens
        assert len(drive.odom_ids) == before + number + 1  # its frame is the odometry's own
    assert drive.stages.lens == given
    assert drive.silent == 0
    assert len(set(drive.odom_ids)) == len(drive.odom_ids)
    drive.stages.close()


def test_a_map_of_another_place_is_not_put_in(world: World) -> None:
    drive = Drive(world, Config())
    while not drive.step():
        assert drive.frame < MOST_FRAMES
    refusal = drive.swap(MAP_FOLDER)
    assert "the old map finds this place" in str(refusal)
    assert drive.step()
    assert drive.stages.map is not None
    assert drive.stages.map.folder == world.map
    drive.stages.close()


def test_held_out_keyframes_are_found_by_the_others(world: World) -> None:
    map_ = open_map(world.map)
    config = Config()
    keyframes = choose_held_out(map_.n_keyframes)
    result = find_held_out(map_, keyframes, config.relocalise, config.tiles)
    assert result.tried == len(keyframes) >= 5
    assert result.found >= 0.6 * result.tried
    assert result.wrong == 0
    more = HeldOut(keyframes=keyframes, found=2 * result.tried)
    with pytest.raises(EdgeError, match="self-test failed"):
        check_held_out(map_, more, config.relocalise, config.tiles)
