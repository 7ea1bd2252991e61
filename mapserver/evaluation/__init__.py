"""Trajectories against ground truth: errors, normalised errors, tables."""
