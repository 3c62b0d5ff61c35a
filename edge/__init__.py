# SPDX-License-Identifier: Apache-2.0
"""Everything that runs on the device."""

__version__ = "0.1.0"
