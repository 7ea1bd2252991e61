"""Recordings as MCAP files: rosbag2 style (CDR) and Foxglove protobuf."""
