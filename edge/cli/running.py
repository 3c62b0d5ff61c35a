# SPDX-License-Identifier: Apache-2.0
"""Commands of the daemon."""

from pathlib import Path

from edge.cli.command_line import Commands


def add(commands: Commands) -> None:
    """Add `run`, `client-key` and `message-schema`."""
    parser = commands.add_parser(
        "run",
        help="run the daemon",
        description="Take frames of the configured camera and publish poses until SIGTERM. "
        "edge/outputs/PROTOCOL.md describes what goes out.",
    )
    parser.add_argument(
        "--config", type=Path, required=True, metavar="FILE", help="settings (TOML)"
    )
    parser.add_argument(
        "--segmenter", type=Path, metavar="MODEL.onnx", help="look for changes with this model"
    )
    parser.set_defaults(run="edge.runtime.daemon_commands:run")

    parser = commands.add_parser(
        "client-key",
        help="make a key pair for encrypted connections",
        description="Write a new secret key to FILE and its public key beside it (FILE.pub). The "
        "device needs a pair of its own, and the public keys of its clients in a list.",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="file of the secret key")
    parser.set_defaults(run="edge.runtime.daemon_commands:client_key")

    parser = commands.add_parser(
        "message-schema",
        help="print the JSON Schema of the live stream's messages",
    )
    parser.set_defaults(run="edge.runtime.daemon_commands:message_schema")
