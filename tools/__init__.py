# SPDX-License-Identifier: Apache-2.0
"""Scripts for developers."""
