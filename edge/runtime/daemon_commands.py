# SPDX-License-Identifier: Apache-2.0
"""What `mapvo run` and its helpers do; heavy modules are imported where they are needed."""

import argparse

import msgspec

from edge.config import load_config
from edge.runtime.commands import with_segmenter
from edge.runtime.journal import log_for_daemon
from edge.runtime.kernel_cache import use_kernel_cache

# ruff: noqa: T201  # printing is what this module is for


def run(args: argparse.Namespace) -> int:
    """`mapvo run`."""
    log_for_daemon()
    config = with_segmenter(load_config(args.config), args.segmenter)
    use_kernel_cache()
    from edge.runtime.run import run as run_daemon

    run_daemon(config)
    return 0


def client_key(args: argparse.Namespace) -> int:
    """`mapvo client-key`."""
    from edge.outputs.curve import make_key_pair

    public = make_key_pair(args.file)
    print(f"{args.file}: the secret key, for its owner alone; {public}: the public one")
    return 0


def message_schema(_args: argparse.Namespace) -> int:
    """`mapvo message-schema`."""
    from edge.outputs.wire import json_schema

    print(msgspec.json.format(msgspec.json.encode(json_schema()), indent=1).decode())
    return 0
