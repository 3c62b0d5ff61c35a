# SPDX-License-Identifier: Apache-2.0
"""Depth of map images: given, from a second camera, from other views, from laser scans."""
