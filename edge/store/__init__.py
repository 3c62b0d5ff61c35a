# SPDX-License-Identifier: Apache-2.0
"""Maps on the device: signed bundles in, generations of content-addressed files on the disk."""
