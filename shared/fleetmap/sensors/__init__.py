"""Sensors as values: samples, calibration, camera models, rectification."""
