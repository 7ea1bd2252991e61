"""Robots, their sensors, and what goes wrong with them."""
