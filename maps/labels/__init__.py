# SPDX-License-Identifier: Apache-2.0
"""What a segmentation model says of the images of a map."""
