# SPDX-License-Identifier: Apache-2.0
"""Holds the odometry on the map: scale, T_map_odom, gates, pose graph."""
