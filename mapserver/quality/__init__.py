"""Measurement of how well a draft's tiles serve a robot, before anyone drives with them. Pure.

Frames not used by the build, or frames of recordings of an earlier version, are relocalized in the tiles as downloaded, with the
robots' relocalizer and its default settings: one frame at a time, without odometry, filter or confirmation over several frames. A
robot does better with the same tiles; a failure here is a fault of the map.
"""
