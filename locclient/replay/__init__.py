"""Replay of recordings: the robot in them, measures of a run, its picture."""
