# SPDX-License-Identifier: Apache-2.0
"""Recordings in one file (MCAP): writing, mending and reading them; FORMAT.md says what is in."""
