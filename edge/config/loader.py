# SPDX-License-Identifier: Apache-2.0
"""Reads a configuration file, or says in one line what is wrong with it."""

import difflib
import math
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import msgspec

from edge.errors import ConfigError

S = TypeVar("S", bound=msgspec.Struct)

HELP = "`mapvo config --defaults` prints all keys"
_UNKNOWN = re.compile(r"unknown field `(?P<key>[^`]+)`")
_NO_CHOICE = re.compile(r"[Ii]nvalid enum value (?P<value>.+)")
_PATH = re.compile(r" - at `\$(?P<path>[^`]*)`$")


def load_struct(path: Path, kind: type[S]) -> S:
    """`kind` filled from the TOML file at `path`; every key not named has its default."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is no UTF-8 text: write it anew with a text editor") from error
    try:
        tree = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: is no TOML: {error}") from error
    if (key := _find_non_finite(tree)) is not None:
        raise ConfigError(f"{_place(path, text, key)}: {key}: must be a finite number")
    try:
        return msgspec.convert(tree, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(_explain(path, text, kind, str(error))) from error


def _explain(path: Path, text: str, kind: type[msgspec.Struct], message: str) -> str:
    """One line from msgspec's, with the key in full and its line in the file."""
    found = _PATH.search(message)
    section = found["path"].lstrip(".") if found else ""
    problem = _PATH.sub("", message)
    if not (unknown := _UNKNOWN.search(problem)):
        problem = _in_words(problem, _type_of(kind, section))
        return f"{_place(path, text, section)}: {section}: {problem}; {HELP}"
    key = f"{section}.{unknown['key']}".lstrip(".")
    close = difflib.get_close_matches(unknown["key"], _keys_of(kind, section), n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    return f"{_place(path, text, key)}: unknown key {key}; {hint}{HELP}"


def _keys_of(kind: type[msgspec.Struct], section: str) -> list[str]:
    """Keys that the table `section` may hold."""
    table = _type_of(kind, section)
    return [item.encode_name for item in msgspec.structs.fields(table)] if _is_table(table) else []


def _in_words(problem: str, wanted: Any) -> str:
    """Msgspec's problem, with what is possible instead of how that is checked."""
    if (given := _NO_CHOICE.search(problem)) and (choices := _choices(wanted)):
        return f"{given['value']} is none of {', '.join(choices)}"
    for meta in get_args(wanted):
        if "matching regex" in problem and isinstance(meta, msgspec.Meta) and meta.description:
            return f"must be {meta.description}"
    return problem[0].lower() + problem[1:]


def _type_of(kind: type[msgspec.Struct], key: str) -> Any:
    """Type of the setting `key`; None where it cannot be told."""
    inner: Any = kind
    for name in filter(None, re.sub(r"\[[^]]*\]", "", key).split(".")):
        if not _is_table(inner):
            return None
        inner = {item.encode_name: item.type for item in msgspec.structs.fields(inner)}.get(name)
    return inner


def _is_table(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _choices(kind: Any) -> list[str]:
    """The values that a type lists, wherever in it."""
    if get_origin(kind) is Literal:
        return [str(value) for value in get_args(kind)]
    return [choice for part in get_args(kind) for choice in _choices(part)]


def _place(path: Path, text: str, key: str) -> str:
    """File and, where the key can be found in it, the line."""
    line = _line_of(text, re.sub(r"\[[^]]*\]", "", key).split("."))
    return f"{path}, line {line}" if line else str(path)


def _line_of(text: str, key: list[str]) -> int | None:
    """The first line that sets `key`, or opens the table that is `key`."""
    table: list[str] = []
    for number, line in enumerate(text.splitlines(), start=1):
        bare = line.split("#")[0].strip()
        if header := re.fullmatch(r"\[\[?([^]]+)\]\]?", bare):
            table = [part.strip().strip("\"'") for part in header[1].split(".")]
            if table[: len(key)] == key:
                return number
        elif "=" in bare:
            name = [part.strip().strip("\"'") for part in bare.split("=")[0].split(".")]
            if table + name == key[: len(table + name)]:
                return number
    return None


def _find_non_finite(tree: Mapping[str, Any], prefix: str = "") -> str | None:
    """Key of the first NaN or infinity, which TOML allows and no setting means."""
    for name, value in tree.items():
        key = f"{prefix}{name}"
        if isinstance(value, Mapping):
            if inner := _find_non_finite(value, f"{key}."):
                return inner
        elif isinstance(value, list):
            if any(isinstance(item, float) and not math.isfinite(item) for item in value):
                return key
        elif isinstance(value, float) and not math.isfinite(value):
            return key
    return None
