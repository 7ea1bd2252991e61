"""Robots, their sensors, and sensor faults."""
