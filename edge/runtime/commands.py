# SPDX-License-Identifier: Apache-2.0
"""What each command of `mapvo` does; heavy modules are imported where they are needed."""

import argparse
import itertools
import os
import sys
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec

from edge.config import Config, load_config
from edge.errors import ConfigError, OutputError
from edge.runtime.kernel_cache import use_kernel_cache
from edge.store import durable

# ruff: noqa: T201  # printing is what this module is for

_MEANINGS = {
    "few matches": "these are other views than the map's, or another place",
    "few features": "the images are dark, blank or blurred",
    "awaiting agreement": (
        "fixes from two places must agree; `mapvo localise` finds single images"
    ),
}
_OTHER_OUT = "name another place with --out"


def replay(args: argparse.Namespace) -> int:
    """`mapvo replay`: returns 130 after Ctrl-C, with the run so far written."""
    _refuse_to_replace(args.out, args.recording, args.map, args.config, args.segmenter)
    config = with_segmenter(load_config(args.config), args.segmenter)
    use_kernel_cache()
    from edge.outputs.run_folder import is_run_folder
    from edge.runtime.replay import ReplayJob
    from edge.runtime.replay import replay as run_replay

    job = ReplayJob(
        recording=args.recording,
        out=args.out,
        map_folder=args.map,
        frames=args.frames,
        stride=args.stride,
        reverse=args.reverse,
        realtime=args.realtime,
    )
    replaces, wanted = is_run_folder(args.out), args.out.resolve()
    stats, folder = run_replay(job, config)
    aside = folder != wanted
    first = stats["first_pose_frame"]
    print(
        f"{folder if aside else args.out}: {stats['frames']} frames, {stats['tracked']} tracked, "
        f"{stats['published']} with a map pose"
        + ("" if first is None else f" (first: frame {first})")
        + f", {stats['cpu_s'] / max(stats['frames'], 1) * 1e3:.1f} ms CPU a frame"
        + (f"; the whole run at {args.out} stays" if aside else "")
        + ("; the earlier run there is gone" if replaces and not aside else "")
    )
    if hint := _hint(args, folder, stats):
        print(hint)
    return 130 if stats["interrupted"] else 0


def _refuse_to_replace(out: Path, *sources: Path | None) -> None:
    """OutputError where a run would take the place of a folder that holds what it reads."""
    from edge.outputs.run_folder import beside

    own = _followed(out)
    for source, folder in itertools.product(filter(None, sources), (own, beside(own))):
        if _followed(source).is_relative_to(folder):
            raise OutputError(f"{folder}: is or holds {source}, which is read: {_OTHER_OUT}")


def _followed(path: Path) -> Path:
    """Where a path leads, there or not; links that lead nowhere, too."""
    return Path(os.path.realpath(path))


def _hint(args: argparse.Namespace, folder: Path, stats: dict[str, Any]) -> str:
    """What to do about a run without the poses that were wanted; empty where it has some."""
    if args.map is not None and not stats["published"]:
        refused = Counter(
            str(msgspec.json.decode(line)["reason"])
            for line in (folder / "fixes.jsonl").read_bytes().splitlines()
        )
        if refused:
            reasons = ", ".join(f"{reason} ({count})" for reason, count in refused.most_common(3))
            meaning = _MEANINGS.get(refused.most_common(1)[0][0], "fixes.jsonl has the numbers")
            return f"no map pose: {reasons}: {meaning}"
    if stats["frames"] and not stats["tracked"]:
        return (
            "never tracked: the odometry starts from some sideways motion, in more than a few "
            "frames; `mapvo localise` finds single images"
        )
    return ""


def with_segmenter(config: Config, model: Path | None) -> Config:
    """The settings with the model of the command line, where it names one."""
    if model is None:
        return config
    segmenter = msgspec.structs.replace(config.segmenter, model=str(model))
    return msgspec.structs.replace(config, segmenter=segmenter)


def localise(args: argparse.Namespace) -> int:
    """`mapvo localise`: returns 130 after Ctrl-C, with what was found so far written."""
    config = load_config(args.config)
    use_kernel_cache()
    from edge.runtime.interrupt import stop_on_signal
    from edge.runtime.localise import localise_images
    from edge.runtime.progress import progress

    replaces = args.out is not None and _holds_fixes(args.out)
    found = []
    with stop_on_signal(lambda: None) as interruption:
        rows = localise_images(args.map, args.images, args.camera, config)
        for row in progress(rows, len(args.images), "images"):
            found.append(row)
            if interruption.came:
                break
    lines = [msgspec.json.encode(row).decode() + "\n" for row in found]
    if args.out is None:
        sys.stdout.writelines(lines)
    else:
        _write_whole(args.out, lines)
        fixes = sum(row.accepted for row in found)
        print(
            f"{args.out}: {fixes} of {len(found)} images found"
            + ("; the earlier fixes there are gone" if replaces else "")
        )
    return 130 if interruption.came else 0


class _FixLine(msgspec.Struct):
    """What tells a line of fixes from any other."""

    accepted: bool
    reason: str


def _holds_fixes(path: Path) -> bool:
    """Whether earlier fixes lie at `path`; OutputError where something else does."""
    try:
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is no regular file; {_OTHER_OUT}")
        with path.open("rb") as file:
            first = file.readline()
        if first:
            msgspec.json.decode(first, type=_FixLine)
        return bool(first)
    except FileNotFoundError:
        return False
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}; {_OTHER_OUT}") from error
    except msgspec.DecodeError as error:
        raise OutputError(f"{path}: exists and holds no fixes; {_OTHER_OUT}") from error


def plot(args: argparse.Namespace) -> int:
    """`mapvo plot`."""
    from edge.runtime.plot import plot_run

    out = args.out or args.run_folder / "plot.png"
    plot_run(args.run_folder, out, map_folder=args.map, truth=args.truth)
    print(out)
    return 0


def warm_up(args: argparse.Namespace) -> int:
    """`mapvo warm-up`."""
    config = load_config(args.config)
    folder = use_kernel_cache()
    from edge.runtime.warm_up import warm_up as run_warm_up

    began = time.monotonic()
    run_warm_up(config)
    print(f"kernels are ready in {folder} ({time.monotonic() - began:.1f} s)")
    return 0


def check_config(args: argparse.Namespace) -> int:
    """`mapvo check-config`."""
    config = load_config(args.file)
    if config.markers.family:
        from edge.markers.finder import MarkerFinder

        try:
            MarkerFinder(config.markers.family)
        except ConfigError as error:
            raise ConfigError(f"{args.file}: markers.family: {error}") from None
    print(f"{args.file}: good")
    return 0


def print_defaults(_args: argparse.Namespace) -> int:
    """`mapvo config --defaults`."""
    from edge.config.printer import to_toml

    print(to_toml(Config()), end="")
    return 0


def _write_whole(path: Path, lines: Iterable[str]) -> None:
    """Write `path` or leave it as it was."""
    try:
        durable.write_whole(path, "".join(lines).encode())
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written: {error.strerror or error}; {_OTHER_OUT}"
        ) from error
