# SPDX-License-Identifier: Apache-2.0
"""Lines in space, found in the images of a map."""
