# SPDX-License-Identifier: Apache-2.0
"""Bundles of little made-up maps, signed with a key of the test's own."""

from pathlib import Path

from edge.store.bundle import Device, OpenBundle, open_bundle
from edge.store.trust import TrustedKeys
from maps.bundle import BundleOrder, bundle
from maps.bundle_keys import NewKey, make_key
from tests.maps.small_map import write_small_map

RUNTIME = Device(runtime="99.0")


class Workstation:
    """Makes keys, maps and bundles below a folder; version 1, 2, ... of site `hall`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "trusted").mkdir(parents=True)
        self.key = make_key(folder / "key.pem")
        self.key.public.rename(folder / "trusted" / "key.pub")
        self.keys = TrustedKeys([folder / "trusted"])

    def map(self, seed: int) -> Path:
        """A map that differs for each seed."""
        folder = self.folder / f"{seed}.map"
        if not folder.exists():
            write_small_map(folder, seed=seed)
        return folder

    def bundle(self, version: int, seed: int | None = None, key: NewKey | None = None) -> Path:
        """Bundle of the map of that seed."""
        order = BundleOrder(site="hall", map_version=version, untested=True, runtime_min="0.1")
        return self.made(order, version if seed is None else seed, key)

    def made(self, order: BundleOrder, seed: int, key: NewKey | None = None) -> Path:
        """Bundle as ordered."""
        out = self.folder / f"{order.site}-{order.map_version}.mapbundle"
        bundle(self.map(seed), (key or self.key).private, out, order)
        return out

    def open(self, path: Path) -> OpenBundle:
        """Bundle as a device that trusts the key opens it."""
        return open_bundle(path, self.keys)
