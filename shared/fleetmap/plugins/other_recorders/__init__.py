"""Recordings by other recorders: MCAP of any kind, rosbag2 in SQLite, ROS 1 bags."""
