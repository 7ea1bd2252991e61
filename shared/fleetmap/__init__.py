"""What both sides of fleetmap must agree on: frames, calibration, features, odometry, map format, recordings, messages."""
