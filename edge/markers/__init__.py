# SPDX-License-Identifier: Apache-2.0
"""Square markers of known size: found in images, measured, and used to tell a pose."""
