# SPDX-License-Identifier: Apache-2.0
"""The user's own instance-segmentation model: what it expects, what it says, and its process."""
