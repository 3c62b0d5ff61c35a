# SPDX-License-Identifier: Apache-2.0
"""Measurements, one script per question; each prints a table."""
