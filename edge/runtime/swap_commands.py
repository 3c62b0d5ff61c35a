# SPDX-License-Identifier: Apache-2.0
"""What `mapvo tiles ...` does, beside a running daemon or without one."""

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec

from edge.config import Config, load_config
from edge.errors import StoreError
from edge.geometry.camera import CameraModel, load_camera
from edge.runtime.kernel_cache import use_kernel_cache
from edge.store.records import Generation
from edge.store.store import Store

# ruff: noqa: T201  # printing is what this module is for

_DAEMON_CACHE = Path("/var/cache/mapvo")
_WAIT_S = 30.0  # for the daemon, beyond the longest rehearsal


def install(args: argparse.Namespace) -> int:
    """`mapvo tiles install`."""
    config, store = _opened(args)
    _become_owner(store.root)
    use_kernel_cache()
    from edge.runtime.swap import this_device, trusted_keys
    from edge.store.bundle import open_bundle

    camera = _calibration(config)
    with open_bundle(args.file, trusted_keys(config.tiles, store)) as bundle:
        generation = store.install(bundle, this_device(config.tiles, camera))
    print(f"{generation.title}: installed")
    return _put_in_use(store, generation, config, "wanted")


def trust(args: argparse.Namespace) -> int:
    """`mapvo tiles trust`."""
    config, store = _opened(args)
    from edge.runtime.swap import trusted_keys

    _become_owner(store.root)
    store.create()
    print(f"{args.file}: {trusted_keys(config.tiles, store).follow(args.file)}")
    return 0


def list(args: argparse.Namespace) -> int:
    """`mapvo tiles list`."""
    _, store = _opened(args)
    marks = {name: store.linked(name) for name in ("current", "good", "previous")}
    if not store.numbers():
        print(f"{store.root}: no map is installed")
    for one in _all_of(store):
        said = [name for name, number in marks.items() if number == one.number]
        size = sum(entry.bytes for entry in one.files)
        ends = "" if one.expires_utc is None else f", expires {one.expires_utc}"
        print(f"{one.title}: {size / 1e6:.1f} MB{ends}" + (f" [{', '.join(said)}]" if said else ""))
    return 0


def verify(args: argparse.Namespace) -> int:
    """`mapvo tiles verify`."""
    _, store = _opened(args)
    if args.number is None and not store.numbers():
        print(f"{store.root}: no map is installed")
    chosen = _all_of(store) if args.number is None else [store.generation(args.number)]
    for generation in chosen:
        print(f"{generation.title}: {store.verify(generation) / 1e6:.1f} MB are in order")
    return 0


def activate(args: argparse.Namespace) -> int:
    """`mapvo tiles activate`."""
    config, store = _opened(args)
    _become_owner(store.root)
    use_kernel_cache()
    wish = "forced" if args.force else "wanted"
    return _put_in_use(store, store.generation(args.number), config, wish)


def rollback(args: argparse.Namespace) -> int:
    """`mapvo tiles rollback`."""
    config, store = _opened(args)
    _become_owner(store.root)
    if not store.daemon_runs():
        print(f"{store.rollback().title}: is used from the next start of mapvo run")
        return 0
    target = store.fallback(store.held())  # a full disk may keep that from being noted
    if target is None:
        raise StoreError(f"{store.root}: there is no other good generation to return to")
    return _put_in_use(store, target, config, "forced")


def gc(args: argparse.Namespace) -> int:
    """`mapvo tiles gc`."""
    _, store = _opened(args)
    if not store.root.is_dir():
        print(f"{store.root}: no map is installed")
        return 0
    _become_owner(store.root)
    freed = store.collect()
    kept = ", ".join(map(str, store.numbers())) or "none"
    print(f"{store.root}: {freed / 1e6:.1f} MB freed, generations left: {kept}")
    return 0


def _opened(args: argparse.Namespace) -> tuple[Config, Store]:
    """Settings and store of a command."""
    path = args.config
    if path is None and args.default_config.exists():
        path = args.default_config
    config = load_config(path)
    if args.store is not None:
        tiles = msgspec.structs.replace(config.tiles, store=str(args.store))
        config = msgspec.structs.replace(config, tiles=tiles)
    if not config.tiles.store:
        raise StoreError("tiles.store: is empty: name a folder for maps there, or give --store DIR")
    return config, Store(Path(config.tiles.store), config.tiles.keep_free_mb * 1_000_000)


def _all_of(store: Store) -> Iterator[Generation]:
    """All generations; at their end StoreError names one whose record is damaged."""
    damaged = None
    for number in store.numbers():
        try:
            generation = store.generation(number)
        except StoreError as error:
            damaged = error
        else:
            yield generation
    if damaged is not None:
        raise damaged


def _put_in_use(store: Store, generation: Generation, config: Config, wish: str) -> int:
    """Let the daemon do it and wait, or do it here where there is none."""
    if store.daemon_runs():
        (store.root / "outcome.json").unlink(missing_ok=True)
        with store.locked():
            store.link(wish, generation.number)
        return _await_daemon(store, generation, config.tiles.rehearsal_s + _WAIT_S)
    if wish == "wanted":
        from edge.runtime.swap import self_test

        self_test(store.map_folder(generation), generation, config)
    store.activate(generation)
    print(f"{generation.title}: is used from the next start of mapvo run")
    return 0


def _await_daemon(store: Store, generation: Generation, wait_s: float) -> int:
    deadline = time.monotonic() + wait_s
    while time.monotonic() < deadline:
        outcome = store.outcome()
        if outcome is not None and outcome.number == generation.number:
            if outcome.ok:
                print(outcome.text)
                return 0
            raise StoreError(outcome.text)
        time.sleep(0.1)
    raise StoreError(f"{generation.title}: mapvo run gave no answer yet; look at its journal")


def _calibration(config: Config) -> CameraModel | None:
    """The camera's calibration, where the settings name a file of it."""
    path = config.camera.calibration
    return load_camera(Path(path)) if path else None


def _become_owner(root: Path) -> None:
    """As root, work as the store's owner: the daemon has to change these files later.

    Compiled kernels are the daemon's, too, where they are kept as `deploy/install.sh` says. Must
    run before anything is compiled.
    """
    nearest = next(folder for folder in (root, *root.absolute().parents) if folder.exists())
    status = nearest.stat()
    if nearest == root and os.geteuid() == 0 and status.st_uid != 0:
        os.setegid(status.st_gid)
        os.seteuid(status.st_uid)
        if os.access(_DAEMON_CACHE, os.W_OK, effective_ids=True):
            os.environ["XDG_CACHE_HOME"] = str(_DAEMON_CACHE)
