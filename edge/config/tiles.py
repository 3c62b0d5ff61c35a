# SPDX-License-Identifier: Apache-2.0
"""Where maps come from in the field, and what a new one has to show."""

from typing import Annotated

from msgspec import Meta, Struct, field

_Share = Annotated[float, Meta(ge=0.0, le=1.0)]


class TilesConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The store of maps; edge/store/BUNDLE.md describes it."""

    # Folder of the store; empty: this device takes no bundles.
    store: str = ""
    # Folders watched for bundles beside the store's own inbox.
    inboxes: list[str] = field(default_factory=list)
    # Public keys (*.pub, PEM) that bundles are believed by, beside the store's own.
    keys: str = "/etc/mapvo/keys"
    # Bundles of other sites are refused; empty: any site's is taken.
    site: Annotated[
        str,
        Meta(
            pattern=r"^([A-Za-z0-9][A-Za-z0-9._-]{0,63})?\Z",
            description="up to 64 letters, digits and . _ -, or empty",
        ),
    ] = ""
    # Left free on the disk by an installation: logs and recordings need room, too.
    keep_free_mb: Annotated[int, Meta(ge=0)] = 200
    # Folders are looked at so often even if nothing told of a change.
    rescan_s: Annotated[float, Meta(gt=0.0, le=3600.0)] = 10.0
    # Of the held-out keyframes that the workstation found, so many have to be found here.
    self_test_share: _Share = 0.8
    # A held-out keyframe found farther off than this share of its scene's depth is found wrongly.
    self_test_depth_share: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.05
    # The new map runs beside the old one for so long at most until it finds the place.
    rehearsal_s: Annotated[float, Meta(gt=0.0, le=3600.0)] = 20.0
    # So many fixes in the old map without a pose in the new one: the new one is not taken.
    rehearsal_fixes: Annotated[int, Meta(ge=1, le=1000)] = 12
    # Runs so long with the new map without an end of the process: then it counts as good.
    good_after_s: Annotated[float, Meta(gt=0.0, le=86_400.0)] = 10.0
    # A map that was not found good is started with so often before the old one comes back.
    trial_starts: Annotated[int, Meta(ge=1, le=100)] = 2
