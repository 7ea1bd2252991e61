"""Replay of recordings: simulated robot, metrics of a run, picture."""
