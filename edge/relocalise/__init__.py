# SPDX-License-Identifier: Apache-2.0
"""Finds single images on the map: features, retrieval, matching, absolute pose."""
