# SPDX-License-Identifier: Apache-2.0
"""The device's maps: installed beside one another, one of them current, each whole or not there.

A map's files are objects named by their hash; a generation is a record of them and a folder of
hard links that opens as a map. What is current is a link. Each step is on the disk before the
next begins, and no step changes what an earlier generation needs.
"""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import msgspec

from edge.errors import BundleRefused, StoreError, TileError
from edge.store import durable
from edge.store.bundle import BundleFile, Device, OpenBundle, check_device
from edge.store.layout import WISHES, Layout
from edge.store.records import (
    Generation,
    Outcome,
    Trial,
    Versions,
    read_note,
    record_of,
)
from edge.store.soundness import check_map, is_sound
from edge.tiles.reader import open_map


class Store(Layout):
    """Installs, switches, checks and removes generations. Any process may use it at any time."""

    def __init__(self, root: Path, keep_free_bytes: int = 0) -> None:
        super().__init__(root)
        self._keep_free_bytes = keep_free_bytes

    def install(self, bundle: OpenBundle, device: Device) -> Generation:
        """Copy a bundle's map into the store; it is not used yet.

        A bundle that is installed already gives the generation that it is, mended if its files or
        its record are damaged.
        """
        self.create()
        header = bundle.header
        check_device(header, device, bundle.name)
        with self.locked(), self._reporting():
            self._clear_staging()
            sound = self.sound_generations()
            known = self._number_of(bundle, sound)
            if known is None:
                self._check_version(bundle, sound)
                self._check_space(bundle)
            number = known or max([0, *self.numbers()]) + 1
            generation = record_of(number, bundle.id, header)
            if known is None or not self._is_whole(generation):
                for entry in header.files:
                    self._take(bundle, entry)
                self._make_folder(generation, bundle.name)
            if generation not in sound:
                record = msgspec.json.format(msgspec.json.encode(generation), indent=1)
                durable.write_whole(self.record(number), record + b"\n")
                self._note_version(generation)
        return generation

    def activate(self, generation: Generation) -> None:
        """Make a generation the current one."""
        with self.locked(), self._reporting():
            self.generation(generation.number)
            self.link("current", generation.number)

    def mark_good(self, generation: Generation) -> None:
        """Believe in a generation: it is what others fall back to from now on."""
        with self.locked(), self._reporting():
            good = self.linked("good")
            if good == generation.number:
                return
            if good is not None:
                self.link("previous", good)
            self.link("good", generation.number)
            durable.remove(self.root / "trial.json")

    def fallback(self, in_use: Generation | None = None) -> Generation | None:
        """The generation to return to from the one `in_use`; without it, from the current one.

        They differ where a full disk kept the one in use from being noted.
        """
        number = self.fallback_number(self.linked("current") if in_use is None else in_use.number)
        return None if number is None else self.generation(number)

    def fallback_number(self, in_use: int | None) -> int | None:
        """Number of that generation, whether it is sound or not."""
        linked = (self.linked(name) for name in ("good", "previous"))
        return next((number for number in linked if number not in (None, in_use)), None)

    def rollback(self) -> Generation:
        """Return to the last good generation, or from that to the one before."""
        target = self.fallback()
        if target is None:
            raise StoreError(f"{self.root}: there is no other good generation to return to")
        self.activate(target)
        with self.locked(), self._reporting():
            self.link("good", target.number)
            durable.remove(self.root / "trial.json")
        return target

    def note_trial(self, number: int) -> int:
        """Count a start with a generation that is not good yet; return how often it was so."""
        last = None
        with suppress(StoreError):  # a damaged note is none
            last = self.trial()
        starts = 1 if last is None or last.number != number else last.starts + 1
        trial = Trial(number, starts)
        with self._reporting():
            durable.write_whole(self.root / "trial.json", msgspec.json.encode(trial))
        return starts

    def note_outcome(self, outcome: Outcome) -> None:
        """Forget the wish, then tell who wished: the next wish may come right after that."""
        with self._reporting():
            for wish in WISHES:
                if self.linked(wish) in (None, outcome.number):  # else another one came
                    durable.remove(self.root / wish)
            durable.write_whole(self.root / "outcome.json", msgspec.json.encode(outcome))

    def verify(self, generation: Generation) -> int:
        """Read every byte of a generation; return how many. StoreError names what is damaged."""
        folder = self.map_folder(generation)
        for entry in generation.files:
            if not is_sound(folder / entry.path, entry):
                raise StoreError(
                    f"{folder / entry.path}: is damaged; install the whole bundle again"
                )
        open_map(folder)
        return sum(entry.bytes for entry in generation.files)

    def collect(self) -> int:
        """Remove generations that nobody needs, and objects of none; return the bytes freed.

        One that is needed and whose record is damaged keeps its map until its bundle comes again.
        """
        with self.locked(), self._reporting():
            before = shutil.disk_usage(self.root).free
            self._clear_staging()
            for number in self.numbers():
                if not self._is_needed(number):
                    durable.remove(self.record(number))
            sound = self.sound_generations()
            folders = {self.map_folder(generation) for generation in sound}
            for number in {*self.numbers()} - {generation.number for generation in sound}:
                folders.update(self.map_folders(number))
            for folder in self.maps.iterdir():
                if folder not in folders and not self.in_use(folder):
                    shutil.rmtree(folder)
            durable.sync_folder(self.maps)
            self._remove_objects({entry.sha256 for one in sound for entry in one.files})
        return max(shutil.disk_usage(self.root).free - before, 0)

    def _is_needed(self, number: int) -> bool:
        linked = {self.linked(name) for name in ("current", "good", "previous", *WISHES)}
        # One newer than the current may be about to be used, or be wished for after a refusal.
        if number in linked or number > (self.linked("current") or 0):
            return True
        return any(self.in_use(folder) for folder in self.map_folders(number))

    def _remove_objects(self, needed: set[str]) -> None:
        """Remove what is in no map's folder either, and not `needed`."""
        for shard in self.objects.iterdir():
            for path in shard.iterdir():
                if path.name not in needed and path.stat().st_nlink == 1:
                    path.unlink()
            durable.sync_folder(shard)

    def _number_of(self, bundle: OpenBundle, sound: list[Generation]) -> int | None:
        """Generation that a bundle is already; a damaged record is known by its map's folder."""
        for known in sound:
            if known.bundle == bundle.id:
                return known.number
        for number in {*self.numbers()} - {known.number for known in sound}:
            if self.map_folder(record_of(number, bundle.id, bundle.header)).is_dir():
                return number
        return None

    def _check_version(self, bundle: OpenBundle, sound: list[Generation]) -> None:
        header = bundle.header
        noted = read_note(self.root / "versions.json", Versions)
        highest = [0 if noted is None else noted.highest.get(header.site, 0)]
        highest += [g.map_version for g in sound if g.site == header.site]
        if header.map_version <= max(highest):
            raise BundleRefused(
                f"{bundle.name}: has version {header.map_version}, version {max(highest)} of site "
                f"{header.site} was here already; make it with a higher one, or use "
                "`mapvo tiles rollback`"
            )

    def _note_version(self, generation: Generation) -> None:
        noted = read_note(self.root / "versions.json", Versions)
        highest = {} if noted is None else noted.highest
        newest = max(generation.map_version, highest.get(generation.site, 0))
        highest = {**highest, generation.site: newest}
        data = msgspec.json.encode(Versions(highest))
        durable.write_whole(self.root / "versions.json", data)

    def _check_space(self, bundle: OpenBundle) -> None:
        needed = sum(
            entry.bytes
            for entry in bundle.header.files
            if entry.carried and not self.object(entry.sha256).exists()
        )
        free = shutil.disk_usage(self.root).free - self._keep_free_bytes
        if needed > free:
            raise BundleRefused(
                f"{bundle.name}: needs {needed / 1e6:.0f} MB, {max(free, 0) / 1e6:.0f} MB may be "
                "used; run `mapvo tiles gc` or make room"
            )

    def _clear_staging(self) -> None:
        for left in self.staging.iterdir():
            if left.is_dir() and not left.is_symlink():
                shutil.rmtree(left)
            else:
                left.unlink()
        for left in self.root.glob(f".*{durable.PART}"):
            left.unlink()

    def _is_whole(self, generation: Generation) -> bool:
        folder = self.map_folder(generation)
        return all(is_sound(folder / entry.path, entry) for entry in generation.files)

    def _take(self, bundle: OpenBundle, entry: BundleFile) -> None:
        """See that the object of a bundle's file is in the store, and sound."""
        target = self.object(entry.sha256)
        if target.exists() and is_sound(target, entry):
            return
        if not entry.carried:
            raise BundleRefused(
                f"{bundle.name}: is a difference, and this device lacks {entry.path}; "
                "install the whole bundle"
            )
        durable.make_folder(target.parent)
        part = self.staging / f"{entry.sha256}{durable.PART}"
        durable.write_new(part, bundle.read(entry), 0o444)
        durable.move(part, target)

    def _make_folder(self, generation: Generation, name: Path) -> None:
        """Make the map's folder of hard links, and see that it opens as a map."""
        partial = Path(tempfile.mkdtemp(dir=self.staging))
        (partial / "tiles").mkdir()
        for entry in generation.files:
            (partial / entry.path).hardlink_to(self.object(entry.sha256))
        try:
            check_map(partial, generation)
        except TileError as error:
            shutil.rmtree(partial)
            what = str(error).replace(f"{partial}/", "")
            raise BundleRefused(f"{name}: holds no map that opens: {what}") from None
        partial.chmod(0o755)
        durable.sync_tree(partial)
        target = self.map_folder(generation)
        if target.exists():
            shutil.rmtree(target)
        durable.move(partial, target)

    @contextmanager
    def _reporting(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            what = error.filename2 or error.filename or self.root
            raise StoreError(
                f"{what}: the store cannot be changed: {error.strerror or error}; "
                "check space, rights and that its disk knows hard links"
            ) from None
