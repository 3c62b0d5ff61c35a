# SPDX-License-Identifier: Apache-2.0
"""Commands that look into maps, check and sign them."""

import argparse
from pathlib import Path

from edge.cli.command_line import Commands, picture


def add(commands: Commands) -> None:
    """Add `inspect`, `verify` and `sign`."""
    inspect = commands.add_parser("inspect", help="say what a map holds")
    inspect.set_defaults(run=_inspect)
    inspect.add_argument("map", type=Path)
    inspect.add_argument(
        "--picture", type=picture, metavar="FILE.png", help="draw it from two sides"
    )
    verify = commands.add_parser("verify", help="check every byte of a map")
    verify.set_defaults(run=_verify)
    verify.add_argument("map", type=Path)
    verify.add_argument(
        "--public-key", type=Path, metavar="FILE", help="and that it was signed with this key"
    )
    sign = commands.add_parser("sign", help="sign a map, so that devices can trust it")
    sign.set_defaults(run=_sign)
    sign.add_argument("map", type=Path)
    sign.add_argument(
        "--key", type=Path, required=True, metavar="FILE", help="Ed25519 private key (PEM)"
    )


def _inspect(arguments: argparse.Namespace) -> None:
    from maps.inspection import table
    from maps.picture import draw

    print(table(arguments.map))
    if arguments.picture is not None:
        draw(arguments.map, arguments.picture)
        print(f"picture: {arguments.picture}")


def _verify(arguments: argparse.Namespace) -> None:
    from maps.verification import verify

    checked = verify(arguments.map)
    signed = ""
    if arguments.public_key is not None:
        from maps.signing import check_signature

        check_signature(arguments.map, arguments.public_key)
        signed = ", signed with this key"
    size = f"{checked.bytes / 1e6:.1f} MB"
    print(f"OK: {checked.tiles} tiles, {size}, {checked.points} points{signed}")


def _sign(arguments: argparse.Namespace) -> None:
    from maps.signing import sign

    print(f"{sign(arguments.map, arguments.key)}: written")
