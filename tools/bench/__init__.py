# SPDX-License-Identifier: Apache-2.0
"""Measurements, one script per question; each prints a table."""

from edge.cli.command_line import one_thread_each

one_thread_each()  # as the product does; BLAS asks when numpy loads, which is after this
