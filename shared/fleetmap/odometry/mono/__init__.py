"""Odometry with one camera."""
