# SPDX-License-Identifier: Apache-2.0
"""Prints a configuration as commented TOML; the comments are those beside the fields."""

import ast
import inspect
import io
import json
import textwrap
import tokenize
from enum import Enum
from typing import Any

import msgspec


def to_toml(config: msgspec.Struct) -> str:
    """TOML text that reads back as `config`, each key under the reason for its value."""
    lines: list[str] = []
    _print_table(config, "", lines)
    return "\n".join(lines).strip() + "\n"


def _print_table(config: msgspec.Struct, name: str, lines: list[str]) -> None:
    comments = _comments(type(config))
    values = {
        item.encode_name: getattr(config, item.name) for item in msgspec.structs.fields(config)
    }
    if name and not all(isinstance(value, msgspec.Struct) for value in values.values()):
        lines += ["", f"# {_summary(type(config))}", f"[{name}]"]
    for key, value in values.items():
        if not isinstance(value, msgspec.Struct):
            lines += [f"# {comment}" for comment in comments.get(key, ())]
            lines.append(f"# {key} =" if value is None else f"{key} = {_to_value(value)}")
    for key, value in values.items():
        if isinstance(value, msgspec.Struct):
            _print_table(value, f"{name}.{key}".lstrip("."), lines)


def _to_value(value: Any) -> str:
    if isinstance(value, Enum):
        return _to_value(value.value)
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_to_value, value)) + "]"
    if isinstance(value, msgspec.Struct):  # one of an array of tables
        items = msgspec.structs.asdict(value).items()
        pairs = (f"{key} = {_to_value(item)}" for key, item in items if item is not None)
        return "{ " + ", ".join(pairs) + " }"
    if isinstance(value, str | bool):
        return json.dumps(value, ensure_ascii=False)
    return repr(value)  # of int and float, TOML's form is Python's


def _summary(kind: type) -> str:
    return (inspect.getdoc(kind) or "").partition("\n")[0]


def _comments(kind: type) -> dict[str, list[str]]:
    """Comment lines above, within or behind each field, by the field's name."""
    source = textwrap.dedent(inspect.getsource(kind))
    by_line = {
        token.start[0]: token.string.lstrip("# ").rstrip()
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT and not token.string.startswith("# noqa")
    }
    body = ast.parse(source).body[0]
    assert isinstance(body, ast.ClassDef)
    found: dict[str, list[str]] = {}
    last = body.body[0].end_lineno or 0
    for node in body.body[1:]:
        end = node.end_lineno or node.lineno
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[node.target.id] = [by_line[n] for n in range(last + 1, end + 1) if n in by_line]
        last = end
    return found
