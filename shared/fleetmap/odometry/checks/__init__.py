"""Checks that an odometry makes of its own inputs: IMU faults, zero velocity, divergence."""
