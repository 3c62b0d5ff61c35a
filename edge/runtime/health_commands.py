# SPDX-License-Identifier: Apache-2.0
"""What `mapvo doctor` and `mapvo support` do."""

import argparse

from edge.config import load_config
from edge.errors import ConfigError
from edge.runtime.doctor import examine, is_fit, to_lines
from edge.runtime.doctor_host import Host
from edge.runtime.doctor_look import look
from edge.runtime.support import write_bundle

# ruff: noqa: T201  # printing is what this module is for


def doctor(args: argparse.Namespace) -> int:
    """`mapvo doctor`: returns 1 where something was found that will not work."""
    config, host = load_config(args.config), _host(args)
    findings = examine(config, host)
    if args.look:
        findings += look(config.camera)
    for line in to_lines(findings):
        print(line)
    return 0 if is_fit(findings) else 1


def support(args: argparse.Namespace) -> int:
    """`mapvo support`."""
    config, host = load_config(args.config), _host(args)
    names = write_bundle(args.out, config, examine(config, host), host, args.recording)
    print(f"{args.out}: {', '.join(names)}; look into it before you give it away")
    return 0


def _host(args: argparse.Namespace) -> Host:
    if not args.root.is_dir():
        raise ConfigError(f"--root {args.root}: is no folder; give the root of a system")
    return Host(args.root)
