# SPDX-License-Identifier: Apache-2.0
"""Direct sparse visual odometry: images in, poses in its own frame and scale out."""
