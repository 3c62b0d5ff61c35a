# SPDX-License-Identifier: Apache-2.0
"""Which camera a calibration is for, and whether it is that one."""

from collections.abc import Iterable

from edge.cameras.v4l2_identity import Identity
from edge.errors import CameraRefused


def binding_of(identity: Identity) -> str:
    """What a calibration of this camera names it by: its socket, and its serial if it has one."""
    parts = [f"path:{identity.by_path}"] if identity.by_path else []
    parts += [f"serial:{identity.serial}"] if identity.serial else []
    return " ".join(parts) or f"path:{identity.node}"


def check_binding(bound: str, identity: Identity, plugged: Iterable[Identity], source: str) -> None:
    """Refuse a calibration of another camera; one that names none holds for any.

    A serial number tells cameras apart in whatever socket they are, but where several have the
    same one, as cheap ones do, the socket counts, too. `source` is the calibration's file.
    """
    if not bound or bound == binding_of(identity):
        return
    path, serial = _parts(bound)
    if serial:
        twins = [other for other in plugged if other.serial == serial]
        if identity.serial == serial and len(twins) <= 1:
            return
    elif path == (identity.by_path or identity.node):
        return
    raise CameraRefused(
        f"{source}: identity: is the calibration of {bound}, but the camera is "
        f"{binding_of(identity)}: plug that one in, or calibrate this one (`mapvo calibrate`)"
    )


def _parts(bound: str) -> tuple[str, str]:
    """Socket and serial number of a binding; the serial comes last, as it may hold blanks."""
    before, _, serial = bound.partition("serial:")
    return before.strip().removeprefix("path:"), serial
