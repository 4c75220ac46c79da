"""Recordings in and out: rosbag2 directories, MCAP files and CSV; no ROS needed."""
