"""Starts the localization client of fleetmap from ROS 2."""
