"""Recordings as MCAP files, of ROS 2 messages in CDR."""
