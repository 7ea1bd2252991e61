"""Odometry of stereo and single cameras, with and without IMU: used live by the robot and for the initial trajectory by the survey."""
