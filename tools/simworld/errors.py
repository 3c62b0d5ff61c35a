# SPDX-License-Identifier: Apache-2.0
"""What can be asked wrongly of a simulated world."""

from edge.errors import EdgeError


class WorldError(EdgeError):
    """No such room, path or effect."""
