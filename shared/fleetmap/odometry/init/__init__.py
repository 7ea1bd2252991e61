"""Initialization of the filter: static, dynamic, and monocular-inertial."""
