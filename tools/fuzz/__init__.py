# SPDX-License-Identifier: Apache-2.0
"""Looks for maps that break their reader."""
