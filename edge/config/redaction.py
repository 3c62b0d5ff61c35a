# SPDX-License-Identifier: Apache-2.0
"""Settings as they may be shown to others."""

import re
from typing import Any

import msgspec

# Names of settings that hold secrets, or the places of such.
_SECRET = re.compile(r"secret|passw|token|credential|(^|_)keys?($|_)", re.IGNORECASE)
LEFT_OUT = "(left out)"


def without_secrets(config: msgspec.Struct) -> dict[str, Any]:
    """All settings as plain values; those that are or name a secret say so instead."""
    plain: dict[str, Any] = msgspec.to_builtins(config)
    return _redact(plain)


def _redact(table: dict[str, Any]) -> dict[str, Any]:
    shown: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, dict):
            shown[key] = _redact(value)
        elif _SECRET.search(key) and value:
            shown[key] = LEFT_OUT
        else:
            shown[key] = value
    return shown
