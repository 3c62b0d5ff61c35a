# SPDX-License-Identifier: Apache-2.0
"""Poses of images that have none: structure from motion by COLMAP, in a process of its own."""
