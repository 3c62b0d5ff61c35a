# SPDX-License-Identifier: Apache-2.0
"""Wires the stages together: threads, replay, live."""
