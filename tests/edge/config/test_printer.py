# SPDX-License-Identifier: Apache-2.0
import re
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, Struct, field

from edge.config import Config, load_config
from edge.config.printer import to_toml


class Lens(Struct, frozen=True, kw_only=True):
    """The glass in front."""

    terms: tuple[float, ...] = (0.5, -1e-9)
    label: str = 'a "b" \\ c'  # any text


class Device(Struct, frozen=True, kw_only=True):
    """A device."""

    # Two lines of
    # reasons.
    rate_hz: float = 30.0
    port: Annotated[
        int | None,
        Meta(gt=0),  # a free one is taken
    ] = None
    mode: Literal["on", "off"] = "on"
    lens: Lens = field(default_factory=Lens)
    ready: bool = True


def test_comments_values_and_tables_are_printed() -> None:
    assert to_toml(Device()) == (
        "# Two lines of\n# reasons.\nrate_hz = 30.0\n"
        "# a free one is taken\n# port =\n"
        'mode = "on"\nready = true\n'
        "\n# The glass in front.\n[lens]\nterms = [0.5, -1e-09]\n"
        '# any text\nlabel = "a \\"b\\" \\\\ c"\n'
    )


def test_defaults_read_back_as_they_are(tmp_path: Path) -> None:
    file = tmp_path / "defaults.toml"
    file.write_text(to_toml(Config()))
    assert load_config(file) == Config()


def test_every_table_and_group_of_keys_begins_with_a_reason() -> None:
    lines = to_toml(Config()).splitlines()
    bare = [
        line
        for before, line in pairwise(lines)
        if re.match(r"\w+ =", line) and (before == "" or before.startswith("["))
    ]
    assert bare == []
