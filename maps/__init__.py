# SPDX-License-Identifier: Apache-2.0
"""Offline map compiler: posed images in, tiles out."""
