"""Monitoring of a robot's calibration: camera observations against the map in which the robot is localized."""
