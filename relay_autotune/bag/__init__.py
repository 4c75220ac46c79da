# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Recordings in and out: rosbag2 directories, MCAP files and CSV; no ROS needed."""
