# SPDX-License-Identifier: Apache-2.0
"""What can go wrong, as one tree.

EdgeError
├── ConfigError         a key or value in a configuration file
├── RecordingError      a recording that cannot be read as one
├── CameraLost          a live source that stopped giving frames; it may come back
├── CameraRefused       a live source whose frames must not be used as it is
├── TileError           a map folder or tile file
│   ├── BadMagic            it is no tile at all
│   ├── UnsupportedVersion  it was written by a newer format
│   └── BadChecksum         its bytes are not those that the manifest names
├── StoreError          the device's store of maps
│   └── BundleRefused       a bundle that must not be installed here
├── ModelRefused        a model that cannot be used, or not surely
└── OutputError         a place that results cannot be written to

Each message is one line: what, which file or key, and what to do. The command
line prints it and exits with status 2.
"""


class EdgeError(Exception):
    """Anything that the user can act on; its text is one line for a person."""


class ConfigError(EdgeError):
    """A key is unknown or a value impossible."""


class RecordingError(EdgeError):
    """A recording is missing, incomplete or of another form."""


class CameraLost(EdgeError):
    """A live source stopped giving frames."""


class CameraRefused(EdgeError):
    """A live source cannot give the frames that are needed; a person has to act."""


class TileError(EdgeError):
    """A map or one of its tiles cannot be used."""


class BadMagic(TileError):
    """The file is no tile."""


class UnsupportedVersion(TileError):
    """The file needs a newer runtime."""


class BadChecksum(TileError):
    """The file's bytes are not those that its manifest names."""


class StoreError(EdgeError):
    """The store of maps cannot do what was asked."""


class BundleRefused(StoreError):
    """A bundle is not for this device, or not to be believed."""


class ModelRefused(EdgeError):
    """A model is of no known form, or gives nonsense."""


class OutputError(EdgeError):
    """Results cannot be written where they should go."""
