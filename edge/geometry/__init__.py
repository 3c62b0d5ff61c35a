# SPDX-License-Identifier: Apache-2.0
"""Rotations, rigid and similarity transforms, camera models: pure mathematics."""
