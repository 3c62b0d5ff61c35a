# SPDX-License-Identifier: Apache-2.0
"""Commands about settings and preparation."""

from pathlib import Path

from edge.cli.command_line import Commands


def add(commands: Commands) -> None:
    """Add `warm-up`, `check-config` and `config`."""
    parser = commands.add_parser(
        "warm-up",
        help="compile all kernels beforehand",
        description="Compile all kernels into the cache, so that no run waits for it.",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML)")
    parser.set_defaults(run="edge.runtime.commands:warm_up")

    parser = commands.add_parser("check-config", help="check a configuration file")
    parser.add_argument("file", type=Path, metavar="FILE", help="settings (TOML)")
    parser.set_defaults(run="edge.runtime.commands:check_config")

    parser = commands.add_parser("config", help="print all settings with their reasons")
    parser.add_argument(
        "--defaults", action="store_true", required=True, help="print the defaults as TOML"
    )
    parser.set_defaults(run="edge.runtime.commands:print_defaults")
