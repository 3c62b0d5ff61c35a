# SPDX-License-Identifier: Apache-2.0
"""Straight lines in images and in space: found, measured, and used to tell a pose."""
