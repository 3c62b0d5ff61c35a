# SPDX-License-Identifier: Apache-2.0
"""Brings new maps from the inbox into use, and the old one back where they are no good."""

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from edge import __version__
from edge.config import Config
from edge.config.tiles import TilesConfig
from edge.errors import EdgeError, StoreError
from edge.geometry.camera import CameraModel
from edge.relocalise.bow import shipped_vocabulary
from edge.runtime.mailbox import Mailbox
from edge.runtime.map_switch import MapHost
from edge.runtime.swap_selftest import check_held_out
from edge.runtime.worker import Worker
from edge.store.bundle import Device, open_bundle
from edge.store.inbox import Inbox
from edge.store.records import Generation, Outcome
from edge.store.store import Store
from edge.store.trust import STATEMENT_SUFFIX, TrustedKeys
from edge.tiles.manifest import camera_entry
from edge.tiles.reader import open_map

log = logging.getLogger(__name__)

_MIN_TRACKED = 30  # frames, before it is said that a map finds nothing
_LOCATED_SHARE = 0.1  # of the tracked frames: less is nothing

# Puts a folder's map in use, after a rehearsal or at once; EdgeError says why it is not.
Swap = Callable[[Path, bool], None]


def open_store(tiles: TilesConfig) -> Store:
    """The store that the settings name."""
    return Store(Path(tiles.store), tiles.keep_free_mb * 1_000_000)


def trusted_keys(tiles: TilesConfig, store: Store) -> TrustedKeys:
    """Keys of the administrator, then those that came in statements."""
    return TrustedKeys([Path(tiles.keys), store.keys])


def this_device(tiles: TilesConfig, camera: CameraModel | None) -> Device:
    """What bundles have to fit, now."""
    return Device(
        runtime=__version__,
        vocabulary=shipped_vocabulary().id,
        site=tiles.site,
        calibration=None if camera is None else camera_entry(camera).id,
        now=datetime.now(UTC),
    )


def self_test(folder: Path, generation: Generation, config: Config) -> None:
    """TileError unless the generation's map opens and can be localised in."""
    map_ = open_map(folder, resident_bytes=config.map.resident_bytes)
    check_held_out(map_, generation.held_out, config.relocalise, config.tiles)


class TileKeeper:
    """Owns the store while the daemon runs; works in a thread of its own.

    Every end of an installation is told on all channels, and beside the file.
    """

    def __init__(
        self, config: Config, store: Store, host: MapHost, swap: Swap, camera: CameraModel
    ) -> None:
        self._config = config
        self._store = store
        self._host = host
        self._swap = swap
        self._camera = camera
        self._keys = trusted_keys(config.tiles, store)
        self._stack = ExitStack()
        self._stack.enter_context(store.daemon())
        self._held = ExitStack()  # the generation in use
        inboxes = [Path(folder) for folder in config.tiles.inboxes]
        self._inbox = Inbox(store.inbox, inboxes, wishes=store.root)
        self._stopped = False
        self._damaged: Mailbox[Path] = Mailbox()  # folder of the map that the daemon has dropped
        self._in_use = self._running()
        self._trial = self._in_use
        self._trial_ends_s = time.monotonic() + config.tiles.good_after_s
        self._was_located = False
        self._trouble = ""  # that keeps it from being noted, as it was told
        self._tested: set[str] = set()  # bundles: what is in the store does not change
        self._worker = Worker("tiles", self._run)

    def return_from_damage(self, map_folder: Path) -> None:
        """Have the map before put in use: the daemon has dropped this one; never waits."""
        self._damaged.offer(map_folder)
        self._inbox.wake()

    def check(self) -> None:
        """Raise here what ended the thread, if anything did."""
        self._worker.check()

    def close(self) -> None:
        """End the thread after the step under way."""
        self._stopped = True
        self._inbox.wake()
        self._worker.join()
        self._inbox.close()
        self._held.close()
        self._stack.close()

    def _run(self) -> None:
        while not self._stopped:
            for folder in self._damaged.drain():
                self._replace_damaged(folder)
            for path in self._inbox.look():
                self._serve(path)
            self._serve_wishes()
            if self._trial is not None and time.monotonic() >= self._trial_ends_s:
                self._end_trial(self._trial)
            left_s = self._trial_ends_s - time.monotonic() if self._trial else 1e9
            self._inbox.wait(max(min(self._config.tiles.rescan_s, left_s), 0.01))

    def _serve(self, path: Path) -> None:
        """Carry out what one file asks for, and answer."""
        ok, text = _outcome(lambda: self._obey(path))
        self._host.tell(text if ok else f"{path.name} refused: {text}")
        self._inbox.answer(path, ok, text)

    def _obey(self, path: Path) -> str:
        if path.suffix == STATEMENT_SUFFIX:
            return self._keys.follow(path)
        with open_bundle(path, self._keys) as bundle:
            device = this_device(self._config.tiles, self._camera)
            generation = self._store.install(bundle, device)
        return self._use(generation, rehearse=True)

    def _serve_wishes(self) -> None:
        """Use the generation that a command has asked for, if any has."""
        for name, rehearse in (("wanted", True), ("forced", False)):
            number = self._store.linked(name)
            if number is None:
                continue
            ok, text = _outcome(partial(self._grant, number, rehearse))
            self._host.tell(text)
            try:
                self._store.note_outcome(Outcome(number, ok, text))
            except EdgeError as error:
                self._host.tell(str(error))

    def _grant(self, number: int, rehearse: bool) -> str:
        return self._use(self._store.generation(number), rehearse)

    def _use(self, generation: Generation, rehearse: bool) -> str:
        """Test, put in use, remember, and say so; EdgeError says why nothing has changed."""
        folder = self._store.map_folder(generation)
        if self._host.map_folder != folder:
            if rehearse and generation.bundle not in self._tested:
                self_test(folder, generation, self._config)
                self._tested.add(generation.bundle)
            self._was_located = self._host.localised().published > 0
            self._swap(folder, rehearse)
            self._hold(generation)
            self._trial = generation
            self._trial_ends_s = time.monotonic() + self._config.tiles.good_after_s
        self._activate(generation)
        return f"{generation.title} is in use"

    def _activate(self, generation: Generation) -> None:
        """See that a generation that is in use is so after the next start, too."""
        if self._store.linked("current") == generation.number:
            return
        try:
            self._store.activate(generation)
        except EdgeError as error:
            raise StoreError(
                f"{generation.title} is in use, but only until the next start: {error}"
            ) from None

    def _end_trial(self, generation: Generation) -> None:
        """Believe in the generation in use, or return to the one before."""
        self._trial = None
        counts = self._host.localised()
        nothing_found = counts.published < _LOCATED_SHARE * counts.tracked
        if self._was_located and counts.tracked >= _MIN_TRACKED and nothing_found:
            self._return_from(generation, counts.published, counts.tracked)
            return
        try:
            self._activate(generation)  # where the disk was full
            self._store.mark_good(generation)
            freed = self._store.collect()
        except EdgeError as error:
            self._note_later(generation, error)
            return
        self._trouble = ""
        log.info("event=map_good generation=%d freed_bytes=%d", generation.number, freed)

    def _note_later(self, generation: Generation, error: EdgeError) -> None:
        """Say why the generation in use could not be noted, once, and try again after a while."""
        if str(error) != self._trouble:
            self._trouble = str(error)
            self._host.tell(self._trouble)
        self._was_located = False  # what it finds has been judged
        self._trial = generation
        self._trial_ends_s = time.monotonic() + self._config.tiles.good_after_s

    def _return_from(self, generation: Generation, published: int, tracked: int) -> None:
        found = f"{generation.title} located {published} of {tracked} frames"
        try:
            old = self._store.fallback(generation)
        except EdgeError as error:
            self._host.tell(f"{found}, and no other can be told: {error}")
            return
        if old is None:
            self._host.tell(f"{found}; there is no other to return to")
        else:
            self._return_to(old, found)

    def _replace_damaged(self, folder: Path) -> None:
        """Return from a map that the daemon has dropped, if there is one to return to."""
        damaged = self._in_use
        if damaged is None or self._store.map_folder(damaged) != folder:
            return  # another map has taken its place meanwhile
        self._trial = self._in_use = None
        self._tested.discard(damaged.bundle)
        try:
            old = self._store.fallback(damaged)
        except EdgeError as error:
            self._host.tell(f"{damaged.title} is damaged, and no other can be told: {error}")
            return
        if old is not None:
            self._return_to(old, f"{damaged.title} is damaged")

    def _return_to(self, old: Generation, why: str) -> None:
        try:
            self._swap(self._store.map_folder(old), False)
        except EdgeError as error:
            self._host.tell(f"{why}, and {old.title} cannot be put in use: {error}")
            return
        self._hold(old)
        self._host.tell(f"{why}: returned to {old.title}")
        try:
            self._activate(old)
        except EdgeError as error:
            self._note_later(old, error)

    def _running(self) -> Generation | None:
        """The generation whose map the daemon has opened at its start."""
        folder = self._host.map_folder
        for generation in self._store.sound_generations():
            if self._store.map_folder(generation) == folder:
                self._hold(generation)
                return generation
        return None

    def _hold(self, generation: Generation) -> None:
        """Keep the generation in use from being collected, and let go of the one before."""
        before = self._held
        self._held = ExitStack()
        self._held.enter_context(self._store.holding(generation))
        self._in_use = generation
        before.close()


def _outcome(work: Callable[[], str]) -> tuple[bool, str]:
    """Whether it was done, and what to say of it.

    Whatever a map does to us is held against the map: an end of the program would be followed by
    a start with the same file in the inbox, and so on for ever.
    """
    try:
        return True, work()
    except EdgeError as error:
        return False, str(error)
    except Exception as error:  # it stands in the journal, and nobody asks for this again
        log.exception("event=map_broke_down")
        return False, f"failed ({type(error).__name__}: {error}); the journal says where"
