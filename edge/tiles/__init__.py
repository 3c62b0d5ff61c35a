# SPDX-License-Identifier: Apache-2.0
"""The tile format and its reader."""
