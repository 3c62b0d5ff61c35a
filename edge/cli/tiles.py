# SPDX-License-Identifier: Apache-2.0
"""Commands about the maps that are installed on this device."""

from pathlib import Path

from edge.cli.command_line import Commands, Parser, positive

DEFAULT_CONFIG = Path("/etc/mapvo/mapvo.toml")


def add(commands: Commands) -> None:
    """Add `tiles` and what belongs to it."""
    tiles = commands.add_parser(
        "tiles",
        help="install, list and change the maps of this device",
        description="The maps of this device: signed bundles are installed beside one another, "
        "one is in use, and the one before comes back if the new one is no good.",
    )
    kinds = tiles.add_subparsers(
        metavar="COMMAND", required=True, parser_class=Parser, dest="tiles_command"
    )
    install = _add(kinds, "install", "check a bundle, install it and put it in use")
    install.add_argument("file", type=Path, metavar="FILE.mapbundle")
    trust = _add(kinds, "trust", "trust a new key because an old one says so")
    trust.add_argument("file", type=Path, metavar="FILE.mapvokeys")
    _add(kinds, "list", "say what is installed, and what is in use")
    verify = _add(kinds, "verify", "read every byte of an installed map")
    verify.add_argument("number", type=positive, nargs="?", metavar="N", help="default: all")
    activate = _add(kinds, "activate", "put an installed map in use")
    activate.add_argument("number", type=positive, metavar="N")
    activate.add_argument(
        "--force", action="store_true", help="without trying it beside the one in use"
    )
    _add(kinds, "rollback", "return to the last good map before the one in use")
    _add(kinds, "gc", "remove maps that nothing uses any more")


def _add(kinds: Commands, name: str, help_text: str) -> Parser:
    parser = kinds.add_parser(name, help=help_text, description=help_text)
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help=f"settings (default: {DEFAULT_CONFIG})"
    )
    parser.add_argument("--store", type=Path, metavar="DIR", help="instead of tiles.store")
    parser.set_defaults(run=f"edge.runtime.swap_commands:{name}", default_config=DEFAULT_CONFIG)
    return parser
